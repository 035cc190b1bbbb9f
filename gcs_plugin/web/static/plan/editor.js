// Drawing on the map: tap corners, drag them, drag a middle to insert one, delete one. With keys: arrows move, Delete removes.

import { make, setAttribute } from "/static/core/dom.js";
import { guarded } from "/static/core/guard.js";
import { t } from "/static/core/strings.js";
import { area, change, onArea, preview, remember, replace } from "/static/plan/area.js";
import { feature, map, maplibregl, show } from "/static/map/map.js";
import { dropTool, takeTool, tool } from "/static/map/tools.js";

const MOST_HANDLES = 150;
const STEP_PX = 8;
let handles = [];
let editing = false;
let dragged = false;
let drawing = -1; // the ring that taps add to
let told = () => {};
export const onDrawing = (work) => { told = work; };
export const isDrawing = () => drawing >= 0;

const same = (a, b) => JSON.stringify(a) === JSON.stringify(b);

// Another page has changed the area: theirs counts, but for the ring that is being drawn here. kept: the rings that both
// pages had before. Says whether theirs lacks something now.
export function mergeDrawn(theirs, kept) {
  const mine = area.rings[drawing] ?? [];
  const at = drawing === 0 ? 0 : theirs.findIndex((ring, k) => k && same(ring, kept[drawing]));
  let rings = [...theirs];
  if (at > 0) rings[at] = mine;
  else if (at < 0) rings = [...(theirs.length ? theirs : area.rings.slice(0, 1)), mine]; // no zone without an outline
  else if (!same(mine, kept[0] ?? [])) rings = [mine, ...theirs.slice(1)];
  drawing = at < 0 ? rings.length - 1 : at;
  replace(rings);
  return mine.length > 2 && !same(rings, theirs);
}

export function draw(ring) {
  takeTool("draw", stopDrawing);
  drawing = ring;
  if (!area.rings[ring]) change((rings) => { rings[ring] = []; });
  told();
}

export function stopDrawing() {
  if (drawing < 0) return;
  drawing = -1;
  dropTool("draw");
  if (area.rings.some((ring, k) => k && ring.length < 3)) change((rings) => { rings.splice(0, rings.length, ...rings.filter((ring, k) => !k || ring.length > 2)); });
  told();
}

export function setEditing(on) {
  editing = on;
  if (!on) stopDrawing();
  handlesAgain();
}

map.on("click", guarded("drawing", (event) => {
  if (tool.active !== "draw") return;
  change((rings) => (rings[drawing] ??= []).push([event.lngLat.lng, event.lngLat.lat]));
}));
map.on("dblclick", () => { if (tool.active === "draw") stopDrawing(); });

const paint = () => {
  const closed = (ring) => [...ring, ring[0]];
  const [outline, zones] = [area.rings[0] ?? [], area.rings.slice(1).filter((ring) => ring.length > 1)];
  show("area", outline.length > 1 ? [feature("Polygon", [outline, ...zones].map(closed))] : zones.map((ring) => feature("LineString", closed(ring))));
};

function handle(ring, index, middle) {
  const points = area.rings[ring];
  const place = middle ? points[index].map((v, axis) => (v + points[(index + 1) % points.length][axis]) / 2) : points[index];
  const element = make("button", { type: "button", class: middle ? "handle middle" : "handle", "aria-label": t(middle ? "edit.middle" : "edit.corner", { n: index + 1 }) });
  const marker = new maplibregl.Marker({ element, draggable: true }).setLngLat(place).addTo(map);
  let at = index;
  marker.on("dragstart", () => {
    remember();
    dragged = true;
    if (middle) { at = index + 1; preview((rings) => rings[ring].splice(at, 0, place)); }
  });
  marker.on("drag", () => preview((rings) => { rings[ring][at] = marker.getLngLat().toArray(); }));
  marker.on("dragend", () => { dragged = false; handlesAgain({ ring, index: at }); });
  element.addEventListener("click", (event) => {
    event.stopPropagation();
    if (middle) { change((rings) => rings[ring].splice(index + 1, 0, place)); focusOn(ring, index + 1); }
  });
  element.addEventListener("dblclick", (event) => {
    event.stopPropagation();
    if (isDrawing()) stopDrawing(); // the second tap that ends a drawing meets the corner of the first
    else if (!middle) removeCorner(ring, index);
  });
  element.addEventListener("keydown", (event) => { if (!middle) byKey(event, ring, index); });
  setAttribute(element, "data-at", `${ring}/${index}${middle ? "m" : ""}`);
  return marker;
}

function removeCorner(ring, index) {
  change((rings) => {
    rings[ring].splice(index, 1);
    if (ring && rings[ring].length < 3) rings.splice(ring, 1);
  });
  focusOn(ring, Math.max(0, index - 1));
}

const MOVES = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
function byKey(event, ring, index) {
  if (event.key === "Delete" || event.key === "Backspace") { event.preventDefault(); removeCorner(ring, index); return; }
  const move = MOVES[event.key];
  if (!move) return;
  event.preventDefault();
  event.stopPropagation();
  const pixel = map.project(area.rings[ring][index]);
  const size = event.shiftKey ? 1 : STEP_PX;
  change((rings) => { rings[ring][index] = map.unproject([pixel.x + move[0] * size, pixel.y + move[1] * size]).toArray(); });
  focusOn(ring, index);
}

const focusAt = (at) => handles.map((h) => h.getElement()).find((e) => e.dataset.at === at)?.focus();
const focusOn = (ring, index) => focusAt(`${ring}/${index}`);

function handlesAgain(focus) {
  dragged = false; // a marker that is removed ends its drag
  for (const marker of handles) marker.remove();
  handles = [];
  if (!editing) return;
  const bounds = map.getBounds();
  for (const [ring, points] of area.rings.entries()) {
    for (let k = 0; k < points.length && handles.length < MOST_HANDLES; k++) {
      if (!bounds.contains(points[k])) continue;
      handles.push(handle(ring, k, false));
      if (points.length > 2 && points.length < 60) handles.push(handle(ring, k, true));
    }
  }
  if (focus) focusOn(focus.ring, focus.index);
}

onArea((why) => { paint(); if (why !== "preview") handlesAgain(); });
map.on("moveend", () => { // other corners are in view now
  if (!editing || dragged) return;
  const at = document.activeElement?.dataset.at;
  handlesAgain();
  if (at) focusAt(at);
});
