// To a place by its coordinates, with a mark on it until the next one.

import { placeOf } from "/static/core/coordinates.js";
import { make, setText } from "/static/core/dom.js";
import { t } from "/static/core/strings.js";
import { map, maplibregl } from "/static/map/map.js";

const NEAR_ZOOM = 18;

export function goToForm() {
  const field = make("input", { type: "search", name: "go-to", placeholder: "47.3977, 8.5456", "aria-label": t("goto.label") });
  const wrong = make("p", { class: "wrong", role: "status" });
  const mark = new maplibregl.Marker({ element: make("i", { class: "cross marked", "aria-hidden": "true" }) });
  return make("form", { class: "row", onsubmit: (event) => {
    event.preventDefault();
    const place = placeOf(field.value);
    setText(wrong, place ? "" : t("goto.wrong"));
    if (!place) return;
    mark.setLngLat(place).addTo(map);
    map.jumpTo({ center: place, zoom: Math.max(NEAR_ZOOM, map.getZoom()) });
  } }, field, make("button", { type: "submit" }, t("goto.go")), wrong);
}
