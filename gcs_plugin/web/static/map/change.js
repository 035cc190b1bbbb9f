// What changed since the basemap: its layer with opacity, and a list that begins with the largest; a press goes there, with
// before and after to swipe between.

import { tileRequest } from "/static/core/api.js";
import { button, keyedList, make, setHidden, setText } from "/static/core/dom.js";
import { changed, state, subscribe } from "/static/core/store.js";
import { t } from "/static/core/strings.js";
import * as units from "/static/core/units.js";
import { boundsOf, fit, isReady, map } from "/static/map/map.js";
import { readAfter, showPicture } from "/static/map/picture_layer.js";
import { shownSwitch } from "/static/map/shown.js";

const ID = "change";
const MOST = 30;
const WAIT_MS = 250; // until the slider stands still
const LEGEND = ["likely", "sure", "hidden"];
let from = 0.5; // probability from which ground is shown
let opacity = 1;
let shown = ""; // version and probability that are on the map
let timer = null;

export function changePanel(compare) {
  const about = make("p", {});
  const toggle = shownSwitch(ID, t("change.show"));
  const clear = make("input", { type: "range", min: 0, max: 100, value: 100, "aria-label": t("change.opacity"), oninput: () => { opacity = clear.value / 100; if (map.getLayer(ID)) map.setPaintProperty(ID, "raster-opacity", opacity); } });
  const words = make("span", {});
  const slider = make("input", { type: "range", min: 20, max: 95, step: 5, value: 50, name: "change-from", oninput: () => { from = slider.value / 100; clearTimeout(timer); timer = setTimeout(() => changed("change"), WAIT_MS); } });
  const legend = make("ul", { class: "shares" }, ...LEGEND.map((key) => make("li", {}, make("i", { class: "swatch", "aria-hidden": "true", dataset: { change: key } }), make("span", {}, t(`change.${key}`)))));
  const list = make("ul", { class: "gaps changes" });
  const more = make("p", { class: "quiet" });
  const go = (row) => { fit(boundsOf([row.bounds.slice(0, 2), row.bounds.slice(2)])); compare(); };
  const draw = keyedList(list, () => { const line = make("li", {}, button("", () => go(line.row)), make("small", { class: "quiet" })); return line; }, (line, row) => {
    line.row = row;
    setText(line.firstChild, t("change.row", { size: units.area(row.area_m2), kind: t(`change.kind.${row.kind}`), p: units.percent(row.probability) }));
    setText(line.lastChild, row.photos.length ? t("change.photos", { names: row.photos.map((photo) => photo.image).join(", ") }) : "");
  });
  subscribe("change", "what changed", () => {
    const known = state.change?.version > 0;
    for (const part of [toggle, clear, legend, slider.parentNode, list, more]) setHidden(part, !known);
    if (!known) { setText(about, t("change.none")); return; }
    const rows = state.change.objects.filter((row) => row.probability >= from);
    setText(about, t("change.shares", { changed: units.percent(state.change.changed_share, 1), hidden: units.percent(state.change.not_visible_share) }));
    setText(words, t("change.from", { p: units.percent(from) }));
    draw(rows.slice(0, MOST).map((row) => [`${row.lat_deg},${row.lon_deg},${row.area_m2}`, row]));
    setHidden(more, rows.length > 0 && rows.length <= MOST);
    setText(more, rows.length ? t("change.more", { n: rows.length - MOST }) : t("change.nothing"));
  });
  return make("section", { class: "change" }, make("h2", {}, t("change.title")), about, make("div", { class: "layer" }, toggle, clear), legend, make("label", { class: "layer" }, words, slider), list, more);
}

subscribe("change ready", "what changed, on the map", () => {
  const key = `${state.change?.version} ${from}`;
  if (!isReady() || !state.change?.corners || key === shown) return;
  shown = key;
  const picture = { url: tileRequest(`/api/change.png?from=${from}&version=${state.change.version}`).url, coordinates: state.change.corners };
  showPicture(ID, picture, { "raster-opacity": opacity });
});

readAfter("change", "change");
