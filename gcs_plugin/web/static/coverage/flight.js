// "Fly the gaps": who flies and for how long, the plan, and one confirmation that uploads it and opens the check before
// the start. Nothing is uploaded before it is confirmed. A vehicle in the air takes part only if its box is ticked: the
// confirmation then pauses it first.

import { get, post } from "/static/core/api.js";
import { dialogBox } from "/static/core/dialog.js";
import { button, make, numberField, setHidden, setText } from "/static/core/dom.js";
import { state } from "/static/core/store.js";
import { t } from "/static/core/strings.js";
import * as units from "/static/core/units.js";
import { command } from "/static/fly/commands.js";
import { openPreflight } from "/static/fly/preflight.js";
import { colourOf } from "/static/map/colours.js";
import { show } from "/static/map/map.js";

const nameOf = (id) => state.vehicles.get(id)?.name || id;
const title = make("h2", { id: "gap-flight-title" }, t("gapflight.title"));
const list = make("ul", { class: "gap-vehicles" });
const status = make("p", { role: "status" });
const height = numberField({ oninput: () => setPlan(null) });
const heightLabel = make("span", {});
const heightRow = make("label", { class: "field" }, heightLabel, height);
const warnings = make("ul", { class: "warnings" });
const summary = make("ul", {});
const planButton = button(t("gapflight.plan"), () => makePlan());
const go = button(t("gapflight.confirm"), () => confirm(), { class: "primary" });
const dialog = dialogBox({ class: "preflight", "aria-labelledby": "gap-flight-title" }, title, make("p", { class: "quiet" }, t("gapflight.about")), list, heightRow, status, summary, warnings,
  make("div", { class: "row wrap" }, planButton, button(t("confirm.no"), () => dialog.close()), go));
dialog.box.addEventListener("close", () => show("gap-plan", []));
export const gapFlightDialog = () => dialog.box;

let rows = [];
let plan = null;

function setPlan(made) {
  plan = made;
  go.disabled = !plan;
  setHidden(summary, !plan);
  summary.replaceChildren(...(plan?.vehicles ?? []).map((row) => make("li", {}, t("gapflight.part", { name: nameOf(plan.names[row.id]), length: units.distance(row.length_m), time: units.clock(row.time_s), photos: row.photos, sorties: row.sorties }))));
  const paused = (plan?.inAir ?? []).map((id) => t("gapflight.pauses", { name: nameOf(id) }));
  warnings.replaceChildren(...[...paused, ...(plan?.warnings ?? [])].map((text) => make("li", {}, units.inUnits(text))));
}

export async function openGapFlight() {
  setPlan(null);
  list.replaceChildren();
  setText(status, "");
  setText(heightLabel, t("plan.altitude_m.takeoff", { unit: units.lengthUnit() }));
  setHidden(heightRow, Boolean(state.coverage?.plan)); // that of the plan, else
  dialog.open();
  try {
    const vehicles = await get("/api/coverage/vehicles");
    rows = vehicles.map((row) => {
      const on = make("input", { type: "checkbox", checked: !row.busy, disabled: Boolean(row.busy) && !row.in_air, onchange: () => setPlan(null) });
      const minutes = numberField({ value: units.typed(row.minutes ?? ""), "aria-label": t("gapflight.minutes", { name: nameOf(row.id) }), oninput: () => setPlan(null) });
      const left = t(row.minutes == null ? "gapflight.ask" : "gapflight.left", { battery: row.battery == null ? "?" : units.percent(row.battery) });
      const words = row.in_air ? `${t("gapflight.inair")} ${left}` : row.busy || left;
      list.append(make("li", {}, make("label", { class: "check" }, on, make("b", {}, nameOf(row.id))), make("small", {}, words), on.disabled ? null : minutes));
      return { id: row.id, on, minutes, inAir: Boolean(row.in_air) };
    });
    setText(status, vehicles.length ? "" : t("gapflight.nobody"));
  } catch (error) {
    setText(status, t("gapflight.failed", { why: error.message }));
  }
}

async function makePlan() {
  setPlan(null);
  const chosen = rows.filter((row) => row.on.checked);
  const asked = chosen.find((row) => !(units.numberOf(row.minutes.value) > 0));
  if (asked) { setText(status, t("gapflight.unknown", { name: nameOf(asked.id) })); asked.minutes.focus(); return; }
  const metres = units.toMetres(units.numberOf(height.value));
  if (!heightRow.hidden && !(metres >= 1)) { setText(status, t("gapflight.height")); height.focus(); return; }
  planButton.disabled = true;
  setText(status, t("plan.making"));
  try {
    const inAir = chosen.filter((row) => row.inAir).map((row) => row.id);
    const wanted = { vehicles: Object.fromEntries(chosen.map((row) => [row.id, units.numberOf(row.minutes.value)])), ...(heightRow.hidden ? {} : { altitude_m: metres }) };
    const made = await post("/api/coverage/flight", inAir.length ? { ...wanted, in_air: inAir } : wanted, 120_000);
    setPlan({ ...made, inAir });
    setText(status, "");
    const features = (await get(`/api/plans/${made.id}/map`)).features ?? [];
    show("gap-plan", features.filter((feature) => feature.geometry?.type === "LineString").map((feature) => ({ ...feature, properties: { ...feature.properties, colour: colourOf(made.names[feature.properties.vehicle]) } })));
  } catch (error) {
    setText(status, t("gapflight.failed", { why: error.message }));
  } finally {
    planButton.disabled = false;
  }
}

// The command that ended last: a vehicle in the air that could not be paused is sent no mission.
async function upload(chosen, mission) {
  const vehicle = chosen.names[mission];
  const paused = chosen.inAir.includes(vehicle) ? await command(vehicle, "pause") : null;
  return paused && paused.outcome !== "done" ? paused : command(vehicle, "upload", { plan: chosen.id, mission });
}

async function confirm() {
  const chosen = plan;
  go.disabled = true;
  setText(status, t("gapflight.uploading"));
  const ended = await Promise.all(chosen.vehicles.map((row) => upload(chosen, row.id)));
  const wrong = ended.filter((entry) => entry.outcome !== "done");
  if (wrong.length) {
    setText(status, t("gapflight.refused", { list: wrong.map((entry) => `${entry.name}: ${entry.reason}`).join("; ") }));
    go.disabled = false;
    return;
  }
  dialog.close();
  openPreflight(chosen, chosen.names);
}
