// Finds: places that somebody marks on the map, with a note and how far off they may be. The daemon keeps them.

import { get, post, request } from "/static/core/api.js";
import { button, keyedList, make, setHidden, setText } from "/static/core/dom.js";
import { notice } from "/static/core/notices.js";
import { settings } from "/static/core/settings.js";
import { changed, state, subscribe } from "/static/core/store.js";
import { positionText } from "/static/core/coordinates.js";
import { position, text } from "/static/core/values.js";
import { t } from "/static/core/strings.js";
import * as units from "/static/core/units.js";
import { circle } from "/static/map/geodesy.js";
import { sigmaAt } from "/static/map/legs.js";
import { feature, map, maplibregl, show } from "/static/map/map.js";
import { dropTool, takeTool, tool } from "/static/map/tools.js";
import { picturesDialog } from "/static/work/find_pictures.js";

const markers = new Map();
const { box: pictures, show: showPictures } = picturesDialog();
document.body.append(pictures);
let absent = false;

export async function loadFinds() {
  try {
    state.finds = (await get("/api/finds")).filter((row) => position(row.lon_deg, row.lat_deg));
  } catch (error) {
    absent = error.status === 404;
  }
  changed("finds");
}

const WITHIN_95 = 2.45; // sigmas an axis; the same of both axes
const withinText = (sigma_m) => (sigma_m > 0 ? t("finds.within", { m: units.distance(WITHIN_95 * sigma_m) }) : t("finds.within.unknown"));

// A find that could not be saved keeps its place: somebody may have looked long for it.
async function save(find) {
  try {
    await post("/api/finds", find);
    await loadFinds();
  } catch (error) {
    if (error.status === 404 || error.status === 405) notice("bad", t("finds.absent"));
    else notice("bad", t("finds.failed", { note: find.note || t("finds.unnamed"), why: error.message }), [t("finds.retry"), () => save(find)]);
  }
}

async function remove(row) {
  try {
    await request("DELETE", `/api/finds/${encodeURIComponent(row.id)}`);
    notice("warn", t("finds.removed", { note: text(row.note) || t("finds.unnamed") }), [t("finds.restore"), () => save(row)]);
    await loadFinds();
  } catch (error) {
    notice("bad", t("finds.stays", { why: error.message }));
  }
}

export function findPanel() {
  const note = make("input", { type: "text", maxlength: 200, placeholder: t("finds.note"), "aria-label": t("finds.note") });
  const mark = button(t("finds.mark"), () => (tool.active === "find" ? stop() : begin()));
  const list = make("ul", { class: "finds" });
  const about = make("p", { class: "quiet", role: "status" });
  const begin = () => { takeTool("find", stop); setText(mark, t("finds.tap")); };
  function stop() { dropTool("find"); setText(mark, t("finds.mark")); }
  map.on("click", async (event) => {
    if (tool.active !== "find") return;
    stop();
    const { lng, lat } = event.lngLat.wrap();
    const words = note.value.trim();
    note.value = "";
    await save({ lat_deg: lat, lon_deg: lng, sigma_m: sigmaAt(lng, lat), note: words });
  });
  const draw = keyedList(list, (row) => make("li", {}, button("", () => map.flyTo({ center: [row.lon_deg, row.lat_deg], zoom: Math.max(18, map.getZoom()), duration: 0 }), { class: "find" }),
    button(t("finds.pictures"), () => showPictures(row), { class: "small" }), button("×", () => remove(row), { class: "close", "aria-label": t("finds.remove") })), (line, row) => {
    setText(line.firstChild, `${text(row.note) || t("finds.unnamed")}: ${positionText(row.lat_deg, row.lon_deg, settings.coordinates)}; ${withinText(row.sigma_m)}`);
  });
  subscribe("finds ready", "finds", () => {
    draw(state.finds.map((row) => [row.id, row]));
    setText(about, absent ? t("finds.absent") : state.finds.length ? "" : t("finds.none"));
    setHidden(about, !about.textContent);
    show("ellipses", state.finds.filter((row) => row.sigma_m > 0).map((row) => feature("Polygon", [circle([row.lon_deg, row.lat_deg], WITHIN_95 * row.sigma_m)])));
    for (const [id, marker] of markers) if (!state.finds.some((row) => row.id === id)) { marker.remove(); markers.delete(id); }
    for (const row of state.finds) {
      if (markers.has(row.id)) continue;
      const element = make("button", { type: "button", class: "find-marker", "aria-label": t("finds.marker", { note: text(row.note) || t("finds.unnamed") }) }, "★");
      markers.set(row.id, new maplibregl.Marker({ element }).setLngLat([row.lon_deg, row.lat_deg]).setPopup(new maplibregl.Popup({ offset: 18 }).setText(text(row.note) || t("finds.unnamed"))).addTo(map));
    }
  });
  return make("section", {}, make("h2", {}, t("finds.title")), make("div", { class: "row wrap" }, note, mark), about, list);
}
