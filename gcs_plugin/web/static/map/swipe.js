// Before and after: a second map with the layer of before, cut at a slider.

import { byId, make, setHidden } from "/static/core/dom.js";
import { t } from "/static/core/strings.js";
import { map, maplibregl, mapOptions } from "/static/map/map.js";
import { rasterLayer, rasterSource } from "/static/map/layers.js";

let before = null;

export function swipeParts() {
  return [make("div", { id: "before", hidden: true, "aria-hidden": "true" }),
    make("div", { id: "divider", hidden: true }, make("span", {}, t("swipe.before")), make("span", {}, t("swipe.after"))),
    make("input", { id: "swipe", type: "range", min: 0, max: 1000, value: 500, "aria-label": t("swipe.label"), hidden: true, oninput: cut })];
}

function cut() {
  const slider = byId("swipe");
  const at = (slider.clientWidth * Number(slider.value)) / 1000;
  byId("before").style.clipPath = `inset(0 calc(100% - ${at}px) 0 0)`;
  byId("divider").style.left = `${at}px`;
}

const follow = () => before.jumpTo({ center: map.getCenter(), zoom: map.getZoom() });

export function setSwipe(on) {
  for (const id of ["before", "divider", "swipe"]) setHidden(byId(id), !on);
  if (!on) {
    before?.remove();
    before = null;
    map.off("move", follow);
    return;
  }
  before = new maplibregl.Map({ ...mapOptions("before"), center: map.getCenter(), zoom: map.getZoom(), interactive: false });
  before.on("load", () => { before.addSource("basemap", rasterSource("basemap")); before.addLayer(rasterLayer("basemap")); });
  map.on("move", follow);
  new ResizeObserver(cut).observe(byId("swipe"));
  cut();
}
