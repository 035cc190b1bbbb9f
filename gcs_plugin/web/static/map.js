// The map: raster layers of the daemon, vehicles with trails and footprints, legs, plans, and the swipe.

import * as maplibregl from "/static/vendor/maplibre-gl.mjs";
import { requestTile } from "/static/api.js";

maplibregl.setWorkerUrl("/static/vendor/maplibre-gl-worker.mjs");

// No green, orange or red: those say how well a leg lies on the map.
export const COLOURS = ["#1c64b0", "#8a3ec4", "#0c8599", "#d6409f", "#1b2a6b", "#6b4f2a", "#495057", "#4d7ea8"];
const colours = new Map();
export const colourOf = (vehicle) => {
  if (!colours.has(vehicle)) colours.set(vehicle, COLOURS[colours.size % COLOURS.length]);
  return colours.get(vehicle);
};

const RASTERS = ["basemap", "realtime", "coarse", "fine"];
const empty = { type: "FeatureCollection", features: [] };
const raster = (name) => ({ type: "raster", tiles: [`${location.origin}/tiles/${name}/{z}/{x}/{y}.webp`], tileSize: 256, maxzoom: 22 });
const rasterLayer = (name) => ({ id: name, type: "raster", source: name, paint: { "raster-fade-duration": 0, "raster-resampling": "linear" } });
const style = (names) => ({
  version: 8,
  sources: Object.fromEntries(names.map((name) => [name, raster(name)])),
  layers: [{ id: "ground", type: "background", paint: { "background-color": "#dfe4e9" } }, ...names.map(rasterLayer)],
});

const options = (container, names) => ({
  container, style: style(names), center: [0, 20], zoom: 1.5, maxZoom: 23, attributionControl: false, dragRotate: false,
  transformRequest: requestTile, canvasContextAttributes: { preserveDrawingBuffer: true },
});

export const map = new maplibregl.Map(options("map", []));
map.addControl(new maplibregl.NavigationControl({ showCompass: false }), "top-left");
map.addControl(new maplibregl.ScaleControl({ maxWidth: 140 }), "bottom-left");
map.touchZoomRotate.disableRotation();

const STATE = ["match", ["get", "state"], "matched", "#2b8a3e", "carried", "#d9780a", "#c92a2a"];
const OVERLAYS = [
  ["footprints", "fill", { "fill-color": ["get", "colour"], "fill-opacity": 0.12, "fill-outline-color": ["get", "colour"] }],
  ["trails", "line", { "line-color": ["get", "colour"], "line-width": 2, "line-opacity": 0.8 }],
  ["legs", "line", { "line-color": "#fff", "line-width": 7, "line-opacity": 0.6 }],
  ["refined", "line", { "line-color": STATE, "line-width": 4, "line-opacity": 0.9 }, ["==", ["get", "stage"], "fine"], "legs"],
  ["flying", "line", { "line-color": STATE, "line-width": 4, "line-opacity": 0.9, "line-dasharray": [2, 1.2] }, ["!=", ["get", "stage"], "fine"], "legs"],
  ["plan", "line", { "line-color": ["coalesce", ["get", "colour"], "#16202a"], "line-width": ["match", ["get", "kind"], "leg", 3, 1.5] }],
  ["area", "fill", { "fill-color": "#1c64b0", "fill-opacity": 0.15, "fill-outline-color": "#1c64b0" }],
  ["corners", "circle", { "circle-radius": 6, "circle-color": "#fff", "circle-stroke-width": 2, "circle-stroke-color": "#1c64b0" }],
];

export const ready = new Promise((resolve) => {
  map.on("load", () => {
    for (const [id, type, paint, filter, source] of OVERLAYS) {
      if (!source) map.addSource(id, { type: "geojson", data: empty });
      map.addLayer({ id, type, source: source || id, paint, ...(filter ? { filter } : {}) });
    }
    resolve();
  });
});

export const show = (id, features) => map.getSource(id)?.setData({ type: "FeatureCollection", features });

// -- raster layers ---------------------------------------------------------------------------------------------------

// A layer comes onto the map once it holds something and the map looks at it: else hundreds of empty tiles of the
// whole world are asked for first.
export function showRaster(name) {
  if (map.getSource(name)) return;
  map.addSource(name, raster(name));
  const above = [...RASTERS.slice(RASTERS.indexOf(name) + 1), OVERLAYS[0][0]].find((id) => map.getLayer(id));
  map.addLayer(rasterLayer(name), above);
  if (shares.has(name)) setOpacity(name, shares.get(name));
}

const shares = new Map();
const versions = new Map();
const stale = new Set();

export function setVersion(name, version) {
  if (versions.get(name) === version) return;
  const first = !versions.has(name);
  versions.set(name, version);
  if (!first) stale.add(name);
}

// Tiles that changed come with another ETag, so asking again costs little; once a second is enough for the eye.
setInterval(() => {
  for (const name of stale) {
    if (!map.getSource(name)) continue;
    if (map.refreshTiles) map.refreshTiles(name);
    else map.getSource(name).setTiles([`${location.origin}/tiles/${name}/{z}/{x}/{y}.webp?v=${versions.get(name)}`]);
  }
  stale.clear();
}, 1000);

export const setOpacity = (name, share) => {
  shares.set(name, share);
  if (!map.getLayer(name)) return;
  map.setPaintProperty(name, "raster-opacity", share);
  map.setLayoutProperty(name, "visibility", share > 0 ? "visible" : "none");
};

// Whether somebody has moved the map by hand; until then it follows what is mapped.
let moved = false;
map.on("movestart", (event) => { moved ||= Boolean(event.originalEvent); });
export const isMoved = () => moved;

// Width at the right that the panel covers, as the style says.
const covered = () => parseFloat(getComputedStyle(document.getElementById("maps")).getPropertyValue("--free") || "360");

export function fit(bounds) {
  const [west, south, east, north] = bounds;
  const right = 30 + covered();
  map.fitBounds([[west, south], [east, north]], { padding: { top: 30, bottom: 50, left: 30, right }, duration: 0, maxZoom: 20 });
}

// -- vehicles --------------------------------------------------------------------------------------------------------

const markers = new Map();

export function placeVehicle(row) {
  if (row.lat_deg == null || row.lon_deg == null) return;
  let marker = markers.get(row.id);
  if (!marker) {
    const element = document.createElement("div");
    element.className = "vehicle";
    element.innerHTML = '<svg viewBox="-17 -17 34 34" width="34" height="34"><path d="M0-14 10 11 0 6-10 11Z" stroke="#fff" stroke-width="2"/></svg><span></span>';
    element.querySelector("path").setAttribute("fill", colourOf(row.id));
    marker = new maplibregl.Marker({ element, rotationAlignment: "map" }).setLngLat([row.lon_deg, row.lat_deg]).addTo(map);
    markers.set(row.id, marker);
  }
  marker.setLngLat([row.lon_deg, row.lat_deg]);
  const element = marker.getElement();
  element.querySelector("svg").style.transform = `rotate(${row.heading_deg ?? 0}deg)`;
  element.querySelector("span").textContent = row.name || row.id;
  element.classList.toggle("lost", row.state === "lost");
}

// -- what lies over the layers -----------------------------------------------------------------------------------------

const OVER = ["footprints", "trails", "legs", "refined", "flying"];

export function setOverlays(on) {
  for (const id of OVER) map.setLayoutProperty(id, "visibility", on ? "visible" : "none");
}

map.on("click", (event) => {
  const legs = map.getLayer("refined") ? map.queryRenderedFeatures(event.point, { layers: ["refined", "flying"] }) : [];
  if (!legs.length || map.getCanvas().style.cursor === "crosshair") return;
  const { vehicle, sortie, leg, state, stage, sigma_m: sigma } = legs[0].properties;
  const flown = Number(sortie) > 1 ? `, sortie ${sortie}` : "";
  const off = sigma == null ? "" : `; its ground is thought to be ${Number(sigma).toFixed(2)} m off (one sigma)`;
  new maplibregl.Popup().setLngLat(event.lngLat).setText(`${vehicle}${flown}, leg ${leg}: ${state}${stage === "fine" ? "" : ", in flight"}${off}`).addTo(map);
});

// -- before and after ------------------------------------------------------------------------------------------------

let before = null;
const clip = () => {
  const box = document.getElementById("swipe").getBoundingClientRect();
  const at = (box.width * Number(document.getElementById("swipe").value)) / 1000;
  document.getElementById("before").style.clipPath = `inset(0 calc(100% - ${at}px) 0 0)`;
  document.getElementById("divider").style.left = `${at}px`;
};

export function setSwipe(on) {
  for (const id of ["before", "divider", "swipe"]) document.getElementById(id).hidden = !on;
  if (!on) return;
  if (!before) {
    before = new maplibregl.Map({ ...options("before", ["basemap"]), center: map.getCenter(), zoom: map.getZoom(), interactive: false });
    map.on("move", () => before.jumpTo({ center: map.getCenter(), zoom: map.getZoom(), bearing: map.getBearing() }));
    document.getElementById("swipe").addEventListener("input", clip);
    new ResizeObserver(clip).observe(document.getElementById("swipe"));
  }
  before.jumpTo({ center: map.getCenter(), zoom: map.getZoom() });
  before.resize();
  clip();
}
