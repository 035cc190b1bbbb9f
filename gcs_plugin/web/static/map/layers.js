// The picture layers in words, with opacity. A layer comes onto the map once it holds something.

import { make, setAttribute, setHidden, setText } from "/static/core/dom.js";
import { tileRequest } from "/static/core/api.js";
import { guarded } from "/static/core/guard.js";
import { state, subscribe } from "/static/core/store.js";
import { t } from "/static/core/strings.js";
import { addInOrder, boundsOf, fit, inView, isMoved, isReady, map, RASTERS } from "/static/map/map.js";

const FLOWN = ["realtime", "coarse", "fine"];
const address = (name) => tileRequest(`/tiles/${name}/{z}/{x}/{y}.webp`).url.replaceAll("%7B", "{").replaceAll("%7D", "}");
export const rasterSource = (name) => ({ type: "raster", tiles: [address(name)], tileSize: 256, maxzoom: 22 });
export const rasterLayer = (name) => ({ id: name, type: "raster", source: name, paint: { "raster-fade-duration": 0 } });

const shares = new Map();
const versions = new Map();
const stale = new Set();
const rows = new Map();
let fitted = "";
let contrast = 0;

function setOpacity(name, share) {
  shares.set(name, share);
  if (!map.getLayer(name)) return;
  map.setPaintProperty(name, "raster-opacity", share);
  map.setLayoutProperty(name, "visibility", share > 0 ? "visible" : "none");
}

// News of a layer's content. Tiles carry ETags, so asking again costs little; once a second is enough for the eye.
function setVersion(name, version) {
  if (versions.get(name) === version) return;
  const first = !versions.has(name);
  versions.set(name, version);
  if (!first) stale.add(name);
}
setInterval(guarded("tiles", () => {
  for (const name of stale) if (map.getSource(name)) map.refreshTiles(name);
  stale.clear();
}), 1000);

function showRaster(name) {
  if (map.getSource(name)) return;
  map.addSource(name, rasterSource(name));
  addInOrder(rasterLayer(name));
  if (contrast && FLOWN.includes(name)) setContrast(contrast);
  if (shares.has(name)) setOpacity(name, shares.get(name));
}

// For eyes in the sun, and for haze: of what was flown.
function setContrast(share) {
  contrast = share;
  for (const name of FLOWN) if (map.getLayer(name)) map.setPaintProperty(name, "raster-contrast", share);
}

export function layerPanel() {
  const line = (name) => {
    const on = make("input", { type: "checkbox", checked: true });
    const opacity = make("input", { type: "range", min: 0, max: 100, value: 100, "aria-label": t("layers.opacity", { name: t(`layers.${name}`) }) });
    const apply = () => setOpacity(name, on.checked ? opacity.value / 100 : 0);
    on.onchange = opacity.oninput = apply;
    const about = make("small", {});
    const row = make("div", { class: "layer", dataset: { layer: name, empty: "true" } }, make("label", { class: "check" }, on, make("span", {}, t(`layers.${name}`))), opacity, about);
    rows.set(name, { row, about });
    return row;
  };
  return make("section", {}, make("h2", {}, t("layers.title")), ...[...RASTERS].reverse().map(line),
    make("label", { class: "layer" }, make("span", {}, t("layers.contrast")), make("input", { type: "range", min: -50, max: 80, value: 0, name: "contrast", oninput: (event) => setContrast(event.target.value / 100) })));
}

subscribe("layers ready", "layers", () => {
  for (const layer of state.layers) {
    guarded(`layer ${layer?.name}`, () => {
      setVersion(layer.name, layer.version);
      const line = rows.get(layer.name);
      if (!line) return;
      setAttribute(line.row, "data-empty", layer.empty ? "true" : "false");
      const about = layer.empty ? t("layers.none") : t(`layers.${layer.name}.about`);
      setText(line.about, layer.attribution ? `${about} \u00b7 ${layer.attribution}` : about);
      setHidden(line.about, false);
    })();
  }
  if (!isReady()) return;
  const full = state.layers.filter((layer) => Array.isArray(layer?.bounds));
  const bounds = mappedBounds();
  if (bounds && String(bounds) !== fitted && !isMoved()) {
    if (!fitted || !inView(bounds)) fit(bounds);
    fitted = String(bounds);
  }
  for (const layer of full) if (RASTERS.includes(layer.name)) guarded(`layer ${layer.name} on the map`, showRaster)(layer.name);
});

// What the pictures of the flights show; before the first one, the basemap.
export function mappedBounds() {
  const full = state.layers.filter((layer) => layer?.bounds?.length === 4 && layer.bounds.every(Number.isFinite));
  const flown = full.filter((layer) => FLOWN.includes(layer.name));
  return boundsOf((flown.length ? flown : full).flatMap(({ bounds }) => [bounds.slice(0, 2), bounds.slice(2)]));
}
