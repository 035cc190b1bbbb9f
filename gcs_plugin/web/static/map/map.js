// The map itself. It repaints only when something on it changes: sources take data only if it differs.

import * as maplibregl from "/static/vendor/maplibre-gl.mjs";
import { tileRequest } from "/static/core/api.js";
import { onSettings, settings } from "/static/core/settings.js";
import { changed } from "/static/core/store.js";
import { t } from "/static/core/strings.js";
import { FREE_LEG, LEGS } from "/static/map/colours.js";

maplibregl.setWorkerUrl(import.meta.resolve("/static/vendor/maplibre-gl-worker.mjs"));
export { maplibregl };

export const EMPTY = { type: "FeatureCollection", features: [] };
export const feature = (type, coordinates, properties = {}) => ({ type: "Feature", properties, geometry: { type, coordinates } });

const STATE = ["match", ["get", "state"], "matched", LEGS.matched.colour, "carried", LEGS.carried.colour, "failed", LEGS.failed.colour, FREE_LEG];
const COLOUR = ["coalesce", ["get", "colour"], "#16202a"];
const SIGN = ["match", ["get", "state"], "matched", "leg-matched", "carried", "leg-carried", "failed", "leg-failed", ""];
const OLD = ["==", ["get", "old"], true]; // a plan that is not of the area and settings any more
// id, type, paint, filter, source if it is not the id, layout
const OVERLAYS = [
  ["footprints", "fill", { "fill-color": COLOUR, "fill-opacity": 0.12, "fill-outline-color": COLOUR }],
  ["trails-edge", "line", { "line-color": "#fff", "line-width": 4, "line-opacity": 0.45 }, null, "trails"],
  ["trails", "line", { "line-color": COLOUR, "line-width": 2, "line-opacity": 0.85 }],
  ["legs", "line", { "line-color": "#fff", "line-width": 7, "line-opacity": 0.6 }],
  ["legs-refined", "line", { "line-color": STATE, "line-width": 4 }, ["==", ["get", "stage"], "fine"], "legs"],
  ["legs-flying", "line", { "line-color": STATE, "line-width": 4, "line-dasharray": [2, 1.2] }, ["!=", ["get", "stage"], "fine"], "legs"],
  ["legs-signs", "symbol", {}, null, "legs", { "symbol-placement": "line-center", "icon-image": SIGN, "icon-rotation-alignment": "viewport", "icon-overlap": "never", "symbol-sort-key": ["match", ["get", "state"], "failed", 0, "carried", 1, 2] }],
  ["area", "fill", { "fill-color": "#1c64b0", "fill-opacity": 0.15 }],
  ["area-line", "line", { "line-color": "#fff", "line-width": 4 }, null, "area"],
  ["area-edge", "line", { "line-color": "#1c64b0", "line-width": 2.5 }, null, "area"],
  ["fences", "fill", { "fill-color": "#c92a2a", "fill-opacity": ["case", ["get", "inside"], 0, 0.2] }],
  ["fences-under", "line", { "line-color": "#000", "line-width": 4.5, "line-opacity": 0.55 }, null, "fences"],
  ["fences-edge", "line", { "line-color": ["case", ["get", "inside"], "#ffc44d", "#ff8a80"], "line-width": 2.5, "line-dasharray": [4, 2] }, null, "fences"],
  ["no-fly", "fill", { "fill-color": "#c92a2a", "fill-opacity": 0.28 }],
  ["no-fly-edge", "line", { "line-color": "#c92a2a", "line-width": 2.5, "line-dasharray": [3, 1.5] }, null, "no-fly"],
  ["plan-edge", "line", { "line-color": "#fff", "line-width": 4, "line-opacity": ["case", OLD, 0.2, 0.6] }, null, "plan"],
  ["plan", "line", { "line-color": ["case", OLD, "#8a94a0", COLOUR], "line-width": ["match", ["get", "kind"], "leg", 3, 1.5], "line-dasharray": [1.2, 1.2] }],
  ["gap-plan-edge", "line", { "line-color": "#fff", "line-width": 4, "line-opacity": 0.6 }, null, "gap-plan"],
  ["gap-plan", "line", { "line-color": COLOUR, "line-width": ["match", ["get", "kind"], "leg", 3, 1.5], "line-dasharray": [1.2, 1.2] }],
  ["routes-flown", "line", { "line-color": COLOUR, "line-width": 1.5, "line-opacity": 0.5 }, ["==", ["get", "part"], "flown"], "routes"],
  ["routes-edge", "line", { "line-color": "#fff", "line-width": 5, "line-opacity": 0.7 }, ["==", ["get", "part"], "left"], "routes"],
  ["routes-left", "line", { "line-color": COLOUR, "line-width": 3 }, ["==", ["get", "part"], "left"], "routes"],
  ["routes-ways", "symbol", {}, ["==", ["get", "part"], "left"], "routes", { "symbol-placement": "line", "symbol-spacing": 120, "icon-image": "way", "icon-overlap": "never", "icon-padding": 20 }],
  ["waypoints", "circle", { "circle-radius": 7, "circle-color": "transparent", "circle-stroke-width": 3, "circle-stroke-color": COLOUR }],
  ["homes", "circle", { "circle-radius": 6, "circle-color": "#fff", "circle-stroke-width": 3, "circle-stroke-color": COLOUR }],
  ["sighting-edge", "line", { "line-color": "#000", "line-width": 5, "line-opacity": 0.6 }, null, "sighting"],
  ["sighting", "line", { "line-color": "#ff7ac3", "line-width": 3 }],
  ["ellipses", "fill", { "fill-color": "#d6409f", "fill-opacity": 0.2, "fill-outline-color": "#d6409f" }],
  ["measure-area", "fill", { "fill-color": "#ffd43b", "fill-opacity": 0.25 }, null, "measure"],
  ["measure-edge", "line", { "line-color": "#000", "line-width": 5, "line-opacity": 0.6 }, null, "measure"],
  ["measure-line", "line", { "line-color": "#ffd43b", "line-width": 3 }, null, "measure"],
];
export const RASTERS = ["basemap", "realtime", "coarse", "fine"];
// From the ground up, in whatever order they come.
const ORDER = ["ground", ...RASTERS, "trust", "change", "coverage", ...OVERLAYS.map(([id]) => id)];
export function addInOrder(layer) {
  map.addLayer(layer, ORDER.slice(ORDER.indexOf(layer.id) + 1).find((id) => map.getLayer(id)));
  changed("overlays");
}

// Where no layer has pixels: no glare at night.
const ground = () => (settings.theme === "sunlight" ? "#cfd6dc" : "#3d4751");

export const mapOptions = (container) => ({
  container, center: [0, 20], zoom: 1.5, maxZoom: 23, attributionControl: false, dragRotate: false, pitchWithRotate: false,
  style: { version: 8, sources: {}, layers: [{ id: "ground", type: "background", paint: { "background-color": ground() } }] },
  transformRequest: tileRequest, fadeDuration: 0, trackResize: true,
  locale: { "Map.Title": t("map.title"), "Marker.Title": t("map.marker"), "NavigationControl.ZoomIn": t("map.zoomin"), "NavigationControl.ZoomOut": t("map.zoomout"), "Popup.Close": t("map.popup.close") },
});

export const map = new maplibregl.Map(mapOptions("map"));
map.addControl(new maplibregl.NavigationControl({ showCompass: false }), "top-right");
onSettings((name) => { if (name === "theme") map.setPaintProperty("ground", "background-color", ground()); });
map.touchZoomRotate.disableRotation();
map.keyboard.disableRotation();

const canvas = (size) => Object.assign(document.createElement("canvas"), { width: size, height: size }).getContext("2d");

// The direction of flight: along a line, pictures point to the right.
function arrowPicture() {
  const pen = canvas(28);
  pen.moveTo(6, 4);
  pen.lineTo(24, 14);
  pen.lineTo(6, 24);
  pen.lineTo(11, 14);
  pen.closePath();
  Object.assign(pen, { fillStyle: "#000", strokeStyle: "#fff", lineWidth: 3, lineJoin: "round" });
  pen.stroke();
  pen.fill();
  return pen.getImageData(0, 0, 28, 28);
}

// A sign in a disc, drawn here: the map's own texts would need fonts from a server.
function signPicture({ colour, sign }) {
  const size = 44;
  const pen = canvas(size);
  pen.beginPath();
  pen.arc(size / 2, size / 2, size / 2 - 2, 0, 2 * Math.PI);
  Object.assign(pen, { fillStyle: "#fff", strokeStyle: colour, lineWidth: 4, font: "bold 30px system-ui, sans-serif", textAlign: "center", textBaseline: "middle" });
  pen.fill();
  pen.stroke();
  pen.fillStyle = "#000";
  pen.fillText(sign, size / 2, size / 2 + 1);
  return pen.getImageData(0, 0, size, size);
}

let loaded = false;
export const isReady = () => loaded;
export const ready = new Promise((resolve) => {
  map.on("load", () => {
    for (const id of new Set(OVERLAYS.map(([name, , , , source]) => source || name))) map.addSource(id, { type: "geojson", data: EMPTY });
    for (const [key, leg] of Object.entries(LEGS)) map.addImage(`leg-${key}`, signPicture(leg), { pixelRatio: 2 });
    map.addImage("way", arrowPicture(), { pixelRatio: 2 });
    for (const [id, type, paint, filter, source, layout] of OVERLAYS) {
      addInOrder({ id, type, source: source || id, paint, ...(filter ? { filter } : {}), ...(layout ? { layout } : {}) });
    }
    loaded = true;
    resolve();
  });
});

const shown = new Map();

// Show features on a source; the same ones again cost nothing.
export function show(id, features) {
  const text = JSON.stringify(features);
  if ((shown.get(id) ?? "[]") === text) return;
  const source = map.getSource(id);
  if (!source) return;
  shown.set(id, text);
  source.setData({ type: "FeatureCollection", features });
}

// Whether somebody has moved the map by hand; until then it follows what is mapped.
let moved = false;
map.on("movestart", (event) => { moved ||= Boolean(event.originalEvent); });
export const isMoved = () => moved;

const PADDING = { top: 84, bottom: 84, left: 56, right: 56 }; // buttons lie over the map's edges; even, so that the centre stays the centre
export function fit([west, south, east, north]) {
  if (![west, south, east, north].every(Number.isFinite)) return;
  map.fitBounds([[west, south], [east, north]], { padding: PADDING, duration: 0, maxZoom: 19 });
}

export function inView([west, south, east, north]) {
  const view = map.getBounds();
  return view.contains([west, south]) && view.contains([east, north]);
}

export function boundsOf(points) {
  if (!points.length) return null;
  const [x, y] = [points.map((p) => p[0]), points.map((p) => p[1])];
  return [Math.min(...x), Math.min(...y), Math.max(...x), Math.max(...y)];
}
