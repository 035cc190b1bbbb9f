// Everything that needs the map: the map itself, and the panels of Plan and Map.

import { button, byId, make } from "/static/core/dom.js";
import { guarded } from "/static/core/guard.js";
import { t } from "/static/core/strings.js";
import { detailsPanel } from "/static/fly/details.js";
import "/static/fly/overlays.js";
import "/static/fly/routes.js";
import { preflightDialog } from "/static/fly/preflight.js";
import { cursorLine } from "/static/map/cursor.js";
import { circle } from "/static/map/geodesy.js";
import { layerPanel, mappedBounds } from "/static/map/layers.js";
import { legPanel } from "/static/map/legs.js";
import { boundsOf, fit, isReady, map, ready } from "/static/map/map.js";
import { measurePanel } from "/static/map/measure.js";
import { goToForm } from "/static/map/go_to.js";
import { shownBox } from "/static/map/shown.js";
import { setSwipe, swipeParts } from "/static/map/swipe.js";
import "/static/map/traffic_markers.js";
import { trustPanel } from "/static/map/trust.js";
import { changePanel } from "/static/map/change.js";
import "/static/map/vehicle_markers.js";
import { setEditing } from "/static/plan/editor.js";
import { loadPlan, planPanel } from "/static/plan/panel.js";
import { olderNote } from "/static/plan/result.js";
import { exportPanel } from "/static/work/exports.js";
import { findPanel, loadFinds } from "/static/work/finds.js";
import { loadPoints, pointPanel } from "/static/work/points.js";
import { jobPanel } from "/static/work/jobs.js";
import { gapFlightDialog } from "/static/coverage/flight.js";
import { coveragePanel } from "/static/coverage/panel.js";
import { area } from "/static/plan/area.js";
import { state, subscribe } from "/static/core/store.js";

function showAll() {
  const vehicles = [...state.vehicles.values()].filter((row) => row.position).map((row) => row.position);
  const mapped = mappedBounds();
  const corners = mapped ? [mapped.slice(0, 2), mapped.slice(2)] : [];
  const fences = [...state.vehicles.values()].flatMap((row) => row.fence?.zones ?? []).flatMap((zone) => (zone.center ? circle(zone.center, zone.radius_m) : zone.ring));
  const bounds = boundsOf([...vehicles, ...fences, ...corners, ...(area.rings[0] ?? [])]);
  if (bounds) fit(bounds);
}

// Before anything is mapped the map goes once to where the vehicles are.
let went = false;
subscribe("vehicles ready", "first look", () => {
  if (went || !isReady() || mappedBounds() || ![...state.vehicles.values()].some((row) => row.position)) return;
  went = true;
  showAll();
});

export async function withMap(panels) {
  const swipe = make("input", { type: "checkbox", id: "swipe-on", onchange: () => setSwipe(swipe.checked) });
  const compare = () => { if (!swipe.checked) swipe.click(); };
  byId("stage").append(...swipeParts(), olderNote(), make("div", { class: "under" }, button(t("map.all"), showAll), ...shownBox(), cursorLine()), detailsPanel());
  panels.plan.append(planPanel());
  panels.map.append(goToForm(), layerPanel(), make("section", {}, make("label", { class: "check" }, swipe, make("span", {}, t("swipe.on")))), changePanel(compare), coveragePanel(), trustPanel(), legPanel(), measurePanel(), findPanel(), pointPanel(), jobPanel(), exportPanel());
  document.body.append(preflightDialog(), gapFlightDialog());
  await ready;
  subscribe("plan", "the shared plan", () => loadPlan());
  subscribe("finds-changed", "finds of others", () => loadFinds());
  subscribe("points-changed", "points of others", () => loadPoints());
  guarded("the plan", loadPlan)();
  guarded("finds", loadFinds)();
  guarded("points", loadPoints)();
  window.orthoswarm = { map };
  return { setEditing };
}
