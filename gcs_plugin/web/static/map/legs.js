// How well the map holds each leg, in words with what they mean; a tap on a leg tells its figures.

import { make, setHidden, setText } from "/static/core/dom.js";
import { state, subscribe } from "/static/core/store.js";
import { t } from "/static/core/strings.js";
import * as units from "/static/core/units.js";
import { LEGS } from "/static/map/colours.js";
import { map, maplibregl, show } from "/static/map/map.js";
import { shownSwitch } from "/static/map/shown.js";
import { tool } from "/static/map/tools.js";

const STATES = ["matched", "carried", "failed"];
const nameOf = (id) => state.vehicles.get(id)?.name ?? id;

// Without a basemap no leg can be found on it, which is no failure of theirs.
const withoutMap = () => state.layers.length > 0 && !state.layers.some((layer) => layer.name === "basemap");

export function legPanel() {
  const lines = STATES.map((key) => [key, make("b", {}), make("small", {}, t(`legs.${key}.about`))]);
  const accuracy = make("p", {});
  const box = make("section", {}, make("h2", {}, t("legs.title")), shownSwitch("legs", t("legs.show")), accuracy,
    ...lines.map(([key, title, about]) => make("p", { class: "leg", dataset: { state: key } }, make("i", { "aria-hidden": "true" }), title, about)), make("p", { class: "quiet" }, t("legs.dashed")));
  subscribe("legs layers ready", "legs", () => {
    const legs = state.legs.filter((leg) => leg?.geometry && leg.properties);
    const free = withoutMap();
    show("legs", free ? legs.map((leg) => ({ ...leg, properties: { ...leg.properties, state: "free" } })) : legs);
    for (const [, title] of lines) setHidden(title.parentNode, free);
    for (const [key, title] of lines) setText(title, `${LEGS[key].sign} ${t(`legs.${key}`, { n: legs.filter((leg) => leg.properties.state === key).length })}`);
    const sigmas = legs.filter((leg) => leg.properties.state === "matched" && Number.isFinite(leg.properties.sigma_m)).map((leg) => leg.properties.sigma_m).sort((a, b) => a - b);
    setText(accuracy, sigmas.length ? t("legs.accuracy", { median: units.distance(sigmas[sigmas.length >> 1]), worst: units.distance(sigmas[Math.floor(0.95 * (sigmas.length - 1))]) }) : t(free ? "legs.free" : legs.length ? "legs.unmatched" : "legs.none"));
  });
  return box;
}

map.on("click", (event) => {
  if (tool.active || !map.getLayer("legs-refined")) return;
  const box = [[event.point.x - 8, event.point.y - 8], [event.point.x + 8, event.point.y + 8]];
  const found = map.queryRenderedFeatures(box, { layers: ["legs-refined", "legs-flying"] })[0];
  if (!found) return;
  const { vehicle, sortie, leg, state: quality, stage, sigma_m: sigma } = found.properties;
  const words = [t("legs.popup", { name: nameOf(vehicle), sortie, leg }), t(`legs.${quality}.about`), stage === "fine" ? "" : t("legs.flying"),
    Number.isFinite(sigma) ? t("legs.sigma", { sigma: units.distance(sigma) }) : ""];
  new maplibregl.Popup().setLngLat(event.lngLat).setText(words.filter(Boolean).join(" ")).addTo(map);
});

// The nearest leg's own estimate of how far its ground is off, in metres; null where nothing is known.
export function sigmaAt(lng, lat) {
  let best = [Infinity, null];
  const east = Math.cos((lat * Math.PI) / 180);
  for (const leg of state.legs) {
    if (!Number.isFinite(leg?.properties?.sigma_m)) continue;
    for (const [x, y] of leg.geometry?.coordinates ?? []) {
      const away = Math.hypot((x - lng) * east, y - lat);
      if (away < best[0]) best = [away, leg.properties.sigma_m];
    }
  }
  return best[0] * 111_320 < 500 ? best[1] : null;
}
