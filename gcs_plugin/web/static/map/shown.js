// What lies over the imagery, by mode: a switch for each. In Map the imagery is clean until somebody switches something on.

import { button, make, setHidden } from "/static/core/dom.js";
import { onSettings, setSetting, settings } from "/static/core/settings.js";
import { changed, subscribe } from "/static/core/store.js";
import { t } from "/static/core/strings.js";
import { map } from "/static/map/map.js";

const LAYERS = {
  routes: ["routes-flown", "routes-edge", "routes-left", "routes-ways", "waypoints"],
  draft: ["plan-edge", "plan"],
  area: ["area", "area-line", "area-edge"],
  zones: ["no-fly", "no-fly-edge"],
  fences: ["fences", "fences-under", "fences-edge"],
  trails: ["trails-edge", "trails"],
  homes: ["homes"],
  footprints: ["footprints"],
  coverage: ["coverage"],
  trust: ["trust"],
  change: ["change"],
  legs: ["legs", "legs-refined", "legs-flying", "legs-signs"],
};
const FIRST = { plan: ["routes", "draft", "area", "zones", "fences", "homes"], fly: ["routes", "area", "zones", "fences", "trails", "homes", "footprints"], map: ["change"] };
const ONLY = { draft: ["plan"], legs: ["map"], trust: ["map"], change: ["map"] }; // in other modes they are not offered
const FILLS = { area: "plan" }; // a fill tints what lies under it

const offered = (group) => !ONLY[group] || ONLY[group].includes(settings.mode);
const isShown = (group) => offered(group) && (settings.shown?.[settings.mode]?.[group] ?? FIRST[settings.mode].includes(group));

function setShown(group, on) {
  setSetting("shown", { ...settings.shown, [settings.mode]: { ...settings.shown?.[settings.mode], [group]: on } });
  changed("overlays");
}

subscribe("overlays ready", "what lies over the imagery", () => {
  for (const [group, ids] of Object.entries(LAYERS)) {
    for (const id of ids) {
      const visible = isShown(group) && (FILLS[id] ?? settings.mode) === settings.mode ? "visible" : "none";
      if (map.getLayer(id) && (map.getLayoutProperty(id, "visibility") ?? "visible") !== visible) map.setLayoutProperty(id, "visibility", visible);
    }
  }
});
onSettings((name) => { if (name === "mode") changed("overlays"); });

// A switch for one of them; several for the same one go together.
export function shownSwitch(group, label = t(`shown.${group}`)) {
  const on = make("input", { type: "checkbox", name: `shown-${group}`, onchange: () => setShown(group, on.checked) });
  const row = make("label", { class: "check" }, on, make("span", {}, label));
  subscribe("overlays", `switch of ${group}`, () => { on.checked = isShown(group); setHidden(row, !offered(group)); });
  return row;
}

// All of them, folded behind a button on the map.
export function shownBox() {
  const list = make("div", { class: "shown", id: "shown", hidden: true, role: "group", "aria-label": t("shown.title") }, ...Object.keys(LAYERS).map((group) => shownSwitch(group)));
  const open = button(t("shown.title"), () => { setHidden(list, !list.hidden); open.setAttribute("aria-expanded", String(!list.hidden)); }, { "aria-expanded": "false", "aria-controls": "shown" });
  list.addEventListener("keydown", (event) => { if (event.key === "Escape") { open.click(); open.focus(); } });
  return [open, list];
}
