// The coordinates under the cursor, or of the map's centre where there is none; and the scale.

import { make, setText } from "/static/core/dom.js";
import { onSettings, settings } from "/static/core/settings.js";
import { positionText } from "/static/core/coordinates.js";
import { t } from "/static/core/strings.js";
import { map, maplibregl } from "/static/map/map.js";

let scale = null;
function setScale() {
  if (scale) map.removeControl(scale);
  scale = new maplibregl.ScaleControl({ maxWidth: 120, unit: settings.units === "us" ? "imperial" : "metric" });
  map.addControl(scale, "bottom-right");
}

export function cursorLine() {
  const line = make("button", { type: "button", class: "cursor", title: t("cursor.copy"), onclick: () => navigator.clipboard?.writeText(line.textContent) });
  let at = null;
  const draw = () => {
    const place = at ?? map.getCenter();
    setText(line, positionText(place.lat, place.lng, settings.coordinates));
  };
  map.on("mousemove", (event) => { at = event.lngLat; draw(); });
  map.on("mouseout", () => { at = null; draw(); });
  map.on("moveend", draw);
  onSettings((name) => { draw(); if (name === "units") setScale(); });
  setScale();
  draw();
  return line;
}
