// Coordinates of the place under the mouse; of the place that a finger tapped, with a mark on it as long as it is in view;
// otherwise of the map's centre, which has a cross where fingers work. And the scale.

import { make, setHidden, setText } from "/static/core/dom.js";
import { notice } from "/static/core/notices.js";
import { onSettings, settings } from "/static/core/settings.js";
import { positionText } from "/static/core/coordinates.js";
import { t } from "/static/core/strings.js";
import { map, maplibregl } from "/static/map/map.js";
import { tool } from "/static/map/tools.js";

let scale = null;
function setScale() {
  if (scale) map.removeControl(scale);
  scale = new maplibregl.ScaleControl({ maxWidth: 120, unit: settings.units === "us" ? "imperial" : "metric" });
  map.addControl(scale, "bottom-right");
}

// Over plain HTTP in the station's network browsers have no clipboard for pages, but copy what is selected.
async function copy(text) {
  try {
    await navigator.clipboard.writeText(text);
    return true;
  } catch {
    const field = make("textarea", { class: "hidden-file", "aria-hidden": "true" });
    field.value = text;
    document.body.append(field);
    field.select();
    const done = document.execCommand("copy");
    field.remove();
    return done;
  }
}

export function cursorLine() {
  const line = make("button", { type: "button", class: "cursor", title: t("cursor.copy"), onclick: tell });
  const cross = make("i", { class: "cross", "aria-hidden": "true" });
  const mark = new maplibregl.Marker({ element: make("i", { class: "cross marked", "aria-hidden": "true" }) });
  map.getContainer().append(cross);
  let fingers = matchMedia("(pointer: coarse)").matches;
  let pointed = null; // under the mouse
  let marked = null; // by a finger
  const place = () => marked ?? pointed ?? map.getCenter();
  const text = () => positionText(place().lat, place().lng, settings.coordinates);
  function draw() {
    if (marked && !map.getBounds().contains(marked)) setMark(null);
    setText(line, marked ? t("cursor.mark", { place: text() }) : pointed ? text() : t("cursor.centre", { place: text() }));
    setHidden(cross, !fingers || Boolean(marked ?? pointed));
  }
  function setMark(at) {
    marked = at;
    if (at) mark.setLngLat(at).addTo(map);
    else mark.remove();
  }
  async function tell() {
    const words = text();
    notice("done", t((await copy(words)) ? "cursor.copied" : "cursor.uncopied", { place: words }));
  }
  map.getContainer().addEventListener("pointerdown", (event) => { fingers = event.pointerType !== "mouse"; if (fingers) pointed = null; }, true);
  map.on("mousemove", (event) => { if (fingers) return; setMark(null); pointed = event.lngLat; draw(); });
  map.on("mouseout", () => { pointed = null; draw(); });
  map.on("click", (event) => { if (fingers && !tool.active) setMark(event.lngLat); draw(); });
  map.on("move", draw);
  onSettings((name) => { draw(); if (name === "units") setScale(); });
  setScale();
  draw();
  return line;
}
