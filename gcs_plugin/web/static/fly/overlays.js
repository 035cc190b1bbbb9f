// Trails, footprints of the last pictures, homes, the vehicles' geofences and no-fly zones: at most once in two seconds, and only if something differs.

import { changed, state, subscribe } from "/static/core/store.js";
import { colourOf } from "/static/map/colours.js";
import { circle } from "/static/map/geodesy.js";
import { feature, show } from "/static/map/map.js";
import { onArea, zones } from "/static/plan/area.js";

const PAUSE_MS = 2000;
let timer = null;
let due = false;

function draw() {
  const rows = [...state.vehicles.values()];
  show("trails", rows.filter((row) => row.trail.length > 1).map((row) => feature("LineString", row.trail, { colour: colourOf(row.id) })));
  show("homes", rows.filter((row) => row.home).map((row) => feature("Point", row.home, { colour: colourOf(row.id) })));
  show("no-fly", [feature("MultiPolygon", zones().coordinates)]);
  const fences = rows.flatMap((row) => row.fence?.zones ?? []).map((zone) => feature("Polygon", [zone.center ? circle(zone.center, zone.radius_m) : [...zone.ring, zone.ring[0]]], { inside: zone.inside }));
  show("fences", [...new Map(fences.map((zone) => [JSON.stringify(zone), zone])).values()]); // one that all vehicles hold is drawn once
  show("footprints", [...state.outlines].filter(([, ring]) => ring.length > 2).map(([id, ring]) => feature("Polygon", [[...ring, ring[0]]], { colour: colourOf(id) })));
}

onArea(() => changed("zones"));
subscribe("vehicles outlines zones ready", "trails and footprints", () => {
  if (timer) { due = true; return; }
  draw();
  timer = setTimeout(() => { timer = null; if (due) { due = false; draw(); } }, PAUSE_MS);
});
