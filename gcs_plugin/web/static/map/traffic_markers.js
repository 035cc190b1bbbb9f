// Other aircraft (ADS-B) on the map: a diamond with callsign and height above sea level.

import { make, setAttribute, setStyle, setText } from "/static/core/dom.js";
import { guarded } from "/static/core/guard.js";
import { state, subscribe } from "/static/core/store.js";
import { t } from "/static/core/strings.js";
import * as units from "/static/core/units.js";
import { map, maplibregl } from "/static/map/map.js";

const SHAPE = '<svg viewBox="-17 -17 34 34" width="34" height="34" aria-hidden="true"><path d="M0-15 9 0 0 9-9 0Z" fill="#ffcf5c" stroke="#000" stroke-width="2"/></svg><span></span>';
const markers = new Map();

const place = (row) => {
  let marker = markers.get(row.id);
  if (!marker) {
    const element = make("div", { class: "vehicle traffic", role: "img" });
    element.innerHTML = SHAPE;
    marker = new maplibregl.Marker({ element }).setLngLat(row.position).addTo(map);
    markers.set(row.id, marker);
  }
  marker.setLngLat(row.position);
  const element = marker.getElement();
  const height = row.alt_m == null ? "–" : units.height(row.alt_m);
  setStyle(element.firstChild, "transform", `rotate(${Math.round(row.heading_deg ?? 0)}deg)`);
  setText(element.lastChild, `${row.name} ${height}`);
  setAttribute(element, "aria-label", t("traffic.one", { name: row.name, height }));
};

subscribe("traffic ready", "other aircraft", () => {
  const here = new Set(state.traffic.map((row) => row.id));
  for (const [id, marker] of markers) if (!here.has(id)) { marker.remove(); markers.delete(id); }
  for (const row of state.traffic) guarded(`aircraft ${row.id}`, place)(row);
});
