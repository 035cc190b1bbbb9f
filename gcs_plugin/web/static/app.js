// The console: three modes over one map, the commands always on the screen, and the news that fill them.

import { button, byId, make, setAttribute, setHidden, setText } from "/static/core/dom.js";
import { linkBanner, linkStatus } from "/static/core/link_status.js";
import { news, refresh } from "/static/core/news.js";
import { noticeBox } from "/static/core/notices.js";
import { problemList } from "/static/core/problems.js";
import { applyTheme, setSetting, settings } from "/static/core/settings.js";
import { settingsDialog } from "/static/core/settings_dialog.js";
import { changed, state } from "/static/core/store.js";
import { listen } from "/static/core/stream.js";
import { t } from "/static/core/strings.js";

const MODES = ["plan", "fly", "map"];

applyTheme();
document.title = t("app.title");
const tabs = MODES.map((mode) => make("button", { type: "button", role: "tab", id: `tab-${mode}`, "aria-controls": `panel-${mode}`, onclick: () => setMode(mode) }, t(`mode.${mode}`)));
const settingsBox = settingsDialog(refresh);
const fold = button("", () => { setSetting("folded", !settings.folded); setMode(settings.mode); }, { class: "fold" });
const grow = button("", () => { setSetting("tall", !settings.tall); setMode(settings.mode); }, { class: "fold grow" });
const header = make("header", {}, make("h1", {}, t("app.title")), make("div", { class: "tabs", role: "tablist", "aria-label": t("mode.title") }, ...tabs), problemList(), linkStatus(),
  button("⚙", settingsBox.open, { class: "icon", "aria-label": t("settings.title") }));
byId("top").replaceWith(header);
document.body.prepend(linkBanner());
document.body.append(settingsBox.box);

// The map is loaded after the bar of commands: a browser without WebGL still commands vehicles.
const { commandBar } = await import("/static/fly/command_bar.js");
byId("bottom").replaceWith(commandBar());
const { stripOf } = await import("/static/fly/tiles.js");
const { alarmList, pastAlarms } = await import("/static/fly/alarms.js");
const panels = Object.fromEntries(MODES.map((mode) => [mode, make("div", { class: "panel", role: "tabpanel", id: `panel-${mode}`, "aria-labelledby": `tab-${mode}`, tabindex: "0" })]));
setAttribute(byId("side"), "aria-label", t("panel.title"));
byId("side").append(grow, fold, ...Object.values(panels));
panels.fly.append(stripOf(), pastAlarms());
byId("stage").append(make("div", { class: "corner" }, alarmList(), noticeBox()));

let setEditing = () => {};
function setMode(mode) {
  setSetting("mode", mode);
  for (const [k, name] of MODES.entries()) {
    setAttribute(tabs[k], "aria-selected", name === mode ? "true" : "false");
    tabs[k].tabIndex = name === mode ? 0 : -1;
    setHidden(panels[name], name !== mode || settings.folded);
  }
  setAttribute(document.body, "data-mode", mode);
  setAttribute(document.body, "data-folded", settings.folded);
  setText(fold, settings.folded ? "»" : "«");
  setAttribute(fold, "aria-label", t(settings.folded ? "panel.open" : "panel.fold"));
  setAttribute(fold, "aria-expanded", settings.folded ? "false" : "true");
  setAttribute(document.body, "data-tall", settings.tall);
  setText(grow, settings.tall ? "▾" : "▴");
  setAttribute(grow, "aria-label", t(settings.tall ? "panel.lower" : "panel.taller"));
  setEditing(mode === "plan");
}
header.querySelector("[role=tablist]").addEventListener("keydown", (event) => {
  const by = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
  if (!by) return;
  const next = (MODES.indexOf(settings.mode) + by + MODES.length) % MODES.length;
  setMode(MODES[next]);
  tabs[next].focus();
});
setMode(MODES.includes(settings.mode) ? settings.mode : "fly");
listen(news);

try {
  const { withMap } = await import("/static/map/stage.js");
  ({ setEditing } = await withMap(panels));
  setMode(settings.mode);
  changed("ready");
} catch (error) {
  state.problems.push(t("app.nomap", { why: error.message }));
  changed("problems");
  throw error;
}
