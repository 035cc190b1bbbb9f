// Vehicles on the map, with name and heading. Markers are moved in place; the map's canvas is not repainted for them.

import { nowMs } from "/static/core/clock.js";
import { setAttribute, setStyle, setText } from "/static/core/dom.js";
import { guarded } from "/static/core/guard.js";
import { select, state, subscribe } from "/static/core/store.js";
import { t } from "/static/core/strings.js";
import { colourOf } from "/static/map/colours.js";
import { map, maplibregl } from "/static/map/map.js";
import { need } from "/static/fly/need.js";

const ARROW = '<svg viewBox="-17 -17 34 34" width="34" height="34" aria-hidden="true"><path d="M0-14 10 11 0 6-10 11Z" stroke="#fff" stroke-width="2"/></svg><span></span>';
const markers = new Map();

function create(row) {
  const element = document.createElement("button");
  element.type = "button";
  element.className = "vehicle";
  element.innerHTML = ARROW;
  element.querySelector("path").setAttribute("fill", colourOf(row.id));
  element.addEventListener("click", (event) => { event.stopPropagation(); select(row.id); });
  const marker = new maplibregl.Marker({ element }).setLngLat(row.position).addTo(map);
  markers.set(row.id, marker);
  return marker;
}

const place = (row, now) => {
  if (!row.position) return;
  const marker = markers.get(row.id) ?? create(row);
  const { lng, lat } = marker.getLngLat();
  if (lng !== row.position[0] || lat !== row.position[1]) marker.setLngLat(row.position);
  const element = marker.getElement();
  setStyle(element.firstChild, "transform", `rotate(${Math.round(row.heading_deg ?? 0)}deg)`);
  setText(element.lastChild, row.name);
  setAttribute(element, "aria-label", t("map.vehicle", { name: row.name }));
  const { level, old } = need(row, now);
  setAttribute(element, "data-level", level);
  setAttribute(element, "data-old", old);
  setAttribute(element, "data-selected", state.selected === row.id);
};

// Names that would lie over each other: the one that needs attention, or is selected, is shown.
const [LABEL_W, LABEL_H] = [56, 18];
function untangle(now) {
  const rank = (row) => (state.selected === row.id ? 9 : need(row, now).weight);
  const rows = [...state.vehicles.values()].filter((row) => markers.has(row.id)).map((row) => ({ row, at: map.project(markers.get(row.id).getLngLat()), rank: rank(row) })).sort((a, b) => b.rank - a.rank);
  const kept = [];
  for (const { row, at } of rows) {
    const free = kept.every((other) => Math.abs(other.x - at.x) > LABEL_W || Math.abs(other.y - at.y) > LABEL_H);
    if (free) kept.push(at);
    setAttribute(markers.get(row.id).getElement(), "data-crowded", !free);
  }
}
map.on("moveend", () => untangle(nowMs()));
subscribe("selected tick", "names on the map", () => untangle(nowMs()));

subscribe("vehicles selected tick", "vehicles on the map", () => {
  const now = nowMs();
  for (const [id, marker] of markers) if (!state.vehicles.has(id)) { marker.remove(); markers.delete(id); }
  for (const row of state.vehicles.values()) guarded(`${row.id} on the map`, place)(row, now);
});
