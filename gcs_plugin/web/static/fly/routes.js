// What each vehicle holds, as read from it: the part flown, the part left with its direction, and the waypoint it flies to.
// A vehicle whose mission is not known has no line: what was planned for it may be another.

import { state, subscribe } from "/static/core/store.js";
import { heldRoute, isLost } from "/static/fly/need.js";
import { colourOf } from "/static/map/colours.js";
import { feature, show } from "/static/map/map.js";

const DONE = "complete";
const UNDER_WAY = new Set(["taking off", "on mission", "paused", "returning"]);

function parts(row, points) {
  const colour = colourOf(row.id);
  const line = (part, places) => (places.length > 1 ? [feature("LineString", places, { part, colour, vehicle: row.id })] : []);
  const places = points.map(([, ...place]) => place);
  if (row.flight.state === DONE) return { lines: line("flown", places), next: [] };
  const under = UNDER_WAY.has(row.flight.state) || (isLost(row) && row.armed);
  const at = points.findIndex(([item]) => item >= row.item);
  if (!under || at < 0) return { lines: line("left", places), next: [] };
  const flown = [...places.slice(0, at), ...(row.position ? [row.position] : [])];
  const left = [...(row.position ? [row.position] : []), ...places.slice(at)];
  return { lines: [...line("flown", at ? flown : []), ...line("left", left)], next: [feature("Point", places[at], { colour, vehicle: row.id })] };
}

subscribe("vehicles routes ready", "what the vehicles hold", () => {
  const drawn = [...state.vehicles.values()].flatMap((row) => { const held = heldRoute(row); return held ? [parts(row, held.points)] : []; });
  show("routes", drawn.flatMap(({ lines }) => lines));
  show("waypoints", drawn.flatMap(({ next }) => next));
});
