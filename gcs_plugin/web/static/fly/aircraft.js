// Other aircraft that are near a vehicle in the air: an alarm for each, with the distance and height from the nearest one.

import { state } from "/static/core/store.js";
import { t } from "/static/core/strings.js";
import * as units from "/static/core/units.js";
import { inAir } from "/static/fly/need.js";
import { lengthOf } from "/static/map/geodesy.js";

const NEAR_M = 500;
const HEIGHT_M = 150;

// Key and alarm of each aircraft; one whose height is not known counts as at the vehicle's height.
export function aircraftNear() {
  const flying = [...state.vehicles.values()].filter((row) => row.position && inAir(row));
  return state.traffic.flatMap((aircraft) => {
    const near = flying.map((row) => ({ row, metres: lengthOf([aircraft.position, row.position]), above: aircraft.alt_m == null || row.alt_m == null ? null : aircraft.alt_m - row.alt_m }))
      .filter(({ metres, above }) => metres <= NEAR_M && Math.abs(above ?? 0) <= HEIGHT_M).sort((a, b) => a.metres - b.metres)[0];
    if (!near) return [];
    const { row, metres, above } = near;
    const height = above == null ? t("aircraft.unknown") : t(above < 0 ? "aircraft.below" : "aircraft.above", { height: units.height(Math.abs(above)) });
    return [[`aircraft/${aircraft.id}`, { level: "bad", text: t("aircraft.near", { aircraft: aircraft.name, metres: units.distance(Math.round(metres)), height, name: row.name }), vehicle: row.id }]];
  });
}
