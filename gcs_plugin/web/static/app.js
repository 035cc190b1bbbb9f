// The panel: what is there, what is being done, and the commands, each with a confirmation.

import { get, post, listen, setToken, token } from "/static/api.js";
import * as view from "/static/map.js";

const $ = (id) => document.getElementById(id);
const make = (tag, attributes = {}, ...children) => {
  const element = document.createElement(tag);
  for (const [key, value] of Object.entries(attributes)) {
    if (key.startsWith("on")) element.addEventListener(key.slice(2), value);
    else if (key in element && key !== "list") element[key] = value;
    else element.setAttribute(key, value);
  }
  element.append(...children.filter((child) => child != null));
  return element;
};

// What went wrong with a command stays until the next one, or until it is dismissed; what is wrong with the daemon, as
// long as it is so.
let failed = "";
let wrong = "";

function tellProblems() {
  $("problem").querySelector("span").textContent = [failed, wrong].filter(Boolean).join("; ");
  $("problem").hidden = !failed && !wrong;
  $("dismiss").hidden = !failed;
}

const attempt = (work) => async (...values) => {
  try {
    failed = "";
    return await work(...values);
  } catch (error) {
    failed = error.message;
  } finally {
    tellProblems();
  }
};
$("dismiss").onclick = () => { failed = ""; tellProblems(); };

function confirmed(question) {
  const dialog = $("confirm");
  dialog.querySelector("p").textContent = question;
  dialog.showModal();
  return new Promise((resolve) => {
    dialog.onclick = (event) => {
      const value = event.target.value;
      if (value === "yes" || value === "no") { dialog.close(); resolve(value === "yes"); }
    };
    dialog.oncancel = () => resolve(false);
  });
}

// -- layers ----------------------------------------------------------------------------------------------------------

const TITLES = { basemap: "Basemap", realtime: "Real time", coarse: "Coarse", fine: "Fine" };
let bounds = null;
let fitted = "";

function drawLayers(rows) {
  const box = $("layers");
  for (const row of rows) {
    view.setVersion(row.name, row.version);
    if (!(row.name in TITLES)) continue;
    let line = box.querySelector(`[data-layer="${row.name}"]`);
    if (!line) {
      const opacity = make("input", { type: "range", min: 0, max: 100, value: 100, "aria-label": `${TITLES[row.name]} opacity` });
      const on = make("input", { type: "checkbox", checked: true, "aria-label": TITLES[row.name] });
      const apply = () => view.setOpacity(row.name, on.checked ? opacity.value / 100 : 0);
      opacity.oninput = on.onchange = apply;
      line = make("div", { className: "row" }, on, make("span", { className: "name" }, TITLES[row.name]), opacity);
      line.dataset.layer = row.name;
      box.append(line);
    }
    line.classList.toggle("off", row.empty);
  }
  const known = rows.filter((row) => row.bounds);
  const best = known.find((row) => row.name === "best") || known.find((row) => row.name === "basemap");
  bounds = best ? best.bounds : bounds;
  const shown = String(bounds);
  if (bounds && shown !== fitted && !view.isMoved() && !corners.length) {
    view.fit(bounds);
    fitted = shown;
  }
  for (const row of rows) if (row.name in TITLES && !row.empty) view.showRaster(row.name);
}

// -- vehicles --------------------------------------------------------------------------------------------------------

const STATES = { pictures: "", found: "", lost: "no link" };
const vehicles = new Map();
const outlines = new Map();

function drawVehicles() {
  const cards = [...vehicles.values()].map((row) => {
    view.placeVehicle(row);
    const colour = view.colourOf(row.id);
    const counts = row.frames || {};
    const mission = row.mission || {};
    const facts = [STATES[row.state] ?? row.state, row.mode, row.armed ? "armed" : "", row.battery == null ? "" : `${Math.round(row.battery * 100)} %`];
    const pictures = [`${counts.frames || 0} pictures`, ...[["refined", counts.fine], ["coarse", counts.coarse], ["rejected", counts.rejected]].filter(([, n]) => n).map(([what, n]) => `${n} ${what}`)].join(", ");
    const share = mission.phase === "complete" ? 1 : mission.items ? mission.item / mission.items : 0;
    return make("div", { className: "card" },
      make("span", { className: "swatch", style: `background:${colour}` }), make("b", {}, row.name || row.id),
      make("span", { className: "quiet" }, facts.filter(Boolean).join(", ")),
      mission.items ? make("div", { className: `bar ${mission.phase === "complete" ? "done" : ""}`, title: `mission ${mission.phase}` }, make("i", { style: `width:${100 * share}%` })) : null,
      mission.items ? make("p", { className: "quiet" }, mission.phase === "complete" ? "mission complete" : `mission ${mission.phase}, item ${mission.item} of ${mission.items}`) : null,
      row.takeoff ? make("p", { className: row.takeoff.failed ? "wrong" : "quiet" }, row.takeoff.failed || `takes off in ${clock(row.takeoff.in_s)}`) : null,
      make("p", { className: "quiet" }, `${pictures}${row.sortie > 1 ? `; sortie ${row.sortie}` : ""}`),
      refinedAfter(row.id) ? make("p", { className: "quiet" }, refinedAfter(row.id)) : null,
      make("div", { className: "buttons" },
        ...(row.system ? ["start", "pause", "resume", "rtl"].map((verb) => make("button", { onclick: () => command(row.id, verb) }, verb)) : []),
        make("button", { onclick: () => refine(row.id) }, "refine now")));
  });
  if (cards.length) $("vehicles").replaceChildren(...cards);
  view.show("trails", [...vehicles.values()].filter((row) => (row.trail || []).length > 1).map((row) => ({
    type: "Feature", properties: { colour: view.colourOf(row.id) }, geometry: { type: "LineString", coordinates: row.trail } })));
  view.show("footprints", [...outlines].map(([vehicle, ring]) => ({
    type: "Feature", properties: { colour: view.colourOf(vehicle) }, geometry: { type: "Polygon", coordinates: [[...ring, ring[0]]] } })));
}

// How long it took from COMPLETE to the refined pixels on the map.
let completions = [];
function refinedAfter(vehicle) {
  const last = completions.filter((row) => row.vehicle === vehicle && row.refine_ended_s).pop();
  return last ? `refined on the map ${(last.refine_ended_s - last.complete_s).toFixed(1)} s after COMPLETE` : "";
}

const command = attempt(async (vehicle, verb) => {
  if (await confirmed(`${verb} vehicle ${vehicle}?`)) await post(`/api/missions/${encodeURIComponent(vehicle)}/${verb}`);
});
const refine = attempt(async (vehicle) => {
  if (await confirmed(vehicle ? `Refine ${vehicle} now?` : "Refine all vehicles now?")) await post("/api/refine", vehicle ? { vehicle } : {});
});

function countLegs(features) {
  const flying = features.filter((leg) => leg.properties.stage !== "fine");
  const of = (state) => features.filter((leg) => leg.properties.state === state).length;
  $("leg-count").textContent = features.length
    ? `${features.length} legs, ${flying.length} of them in flight: ${of("matched")} matched, ${of("carried")} carried, ${of("failed")} failed` : "";
}

// -- jobs and exports ------------------------------------------------------------------------------------------------

const jobs = new Map();
const NAMES = { refine: "Refine", together: "Neighbours", redraw: "Draw again", export: "Export", coarse: "Coarse" };

function drawJobs() {
  // What is done in the background comes and goes by itself: only what is under way, or went wrong, is worth a line.
  const shown = [...jobs.values()].filter((job) => !["coarse", "together"].includes(job.kind) || job.state === "running" || job.state === "failed");
  const latest = shown.sort((a, b) => b.id - a.id).slice(0, 12);
  if (latest.length) {
    $("jobs").replaceChildren(...latest.map((job) => make("div", { className: "card" },
      make("b", {}, NAMES[job.kind] || job.kind), `${job.vehicle || ""}${job.sortie > 1 ? ` sortie ${job.sortie}` : ""} `,
      make("span", { className: "quiet" }, [job.state, job.message, ...(job.detail.warnings || []), job.detail.seconds ? `${job.detail.seconds.toFixed(1)} s` : ""].filter(Boolean).join(", ")),
      make("div", { className: `bar ${job.state}` }, make("i", { style: `width:${100 * job.progress}%` })))));
  }
  const made = [...jobs.values()].filter((job) => job.detail.files).pop();
  if (made) {
    const query = token() ? `?token=${encodeURIComponent(token())}` : "";
    $("exports").replaceChildren(...Object.keys(made.detail.files).map((kind) =>
      make("p", {}, make("a", { href: `/api/export/${made.id}/${kind}${query}`, download: "" }, `${kind}: ${made.detail.files[kind]}`))));
  }
}

$("export-form").querySelector(".checks").append(...["cog", "mbtiles", "kmz", "gpkg", "odm"].map((kind) =>
  make("label", {}, make("input", { type: "checkbox", name: kind, checked: kind === "cog" || kind === "kmz" }), kind)));
$("export-form").onsubmit = attempt(async (event) => {
  event.preventDefault();
  const formats = [...new FormData(event.target).keys()];
  await post("/api/export", { formats });
});

// -- planning --------------------------------------------------------------------------------------------------------

let drawing = false;
let corners = [];
let plan = null;

function drawArea() {
  view.show("corners", corners.map((point) => ({ type: "Feature", properties: {}, geometry: { type: "Point", coordinates: point } })));
  view.show("area", corners.length > 2 ? [{ type: "Feature", properties: {}, geometry: { type: "Polygon", coordinates: [[...corners, corners[0]]] } }] : []);
  $("make").disabled = corners.length < 3;
  $("plan-hint").textContent = drawing ? `Tap the corners on the map (${corners.length} so far), then plan.`
    : plan ? "Look at the lines, upload the missions, then start." : corners.length > 2 ? "The area is drawn: plan it." : "Draw the area that is to be mapped.";
  $("draw").textContent = drawing ? "Done" : "Draw area";
}

view.map.on("click", (event) => {
  if (!drawing) return;
  corners.push([event.lngLat.lng, event.lngLat.lat]);
  drawArea();
});
$("draw").onclick = () => { drawing = !drawing; if (drawing && plan) clearPlan(); view.map.getCanvas().style.cursor = drawing ? "crosshair" : ""; drawArea(); };
$("clear").onclick = () => { corners = []; drawing = false; clearPlan(); drawArea(); };

function clearPlan() {
  plan = null;
  view.show("plan", []);
  $("plan-result").replaceChildren();
}

$("plan-form").onsubmit = attempt(async (event) => {
  event.preventDefault();
  drawing = false;
  drawArea();
  const form = new FormData(event.target);
  const heard = [...vehicles.values()].filter((row) => row.system && row.lat_deg != null);
  const body = { area: { type: "Polygon", coordinates: [[...corners, corners[0]]] }, end: form.get("end") };
  for (const key of ["vehicles", "altitude_m", "fov_min_deg"]) body[key] = Number(form.get(key));
  if (heard.length >= body.vehicles) body.starts = heard.slice(0, body.vehicles).map((row) => [row.lat_deg, row.lon_deg]);
  $("make").disabled = true;
  try {
    plan = await post("/api/plans", body);
    const able = heard.length >= plan.vehicles.length;
    plan.names = Object.fromEntries(able ? plan.vehicles.map((row, k) => [row.id, heard[k].id]) : []);
  } finally {
    $("make").disabled = false;
  }
  const picture = await get(`/api/plans/${plan.id}/map`);
  view.show("plan", picture.features.filter((f) => f.geometry.type === "LineString").map((f) => ({ ...f, properties: { ...f.properties, colour: view.colourOf(flies(f.properties.vehicle)) } })));
  drawPlan();
});

const clock = (seconds) => `${Math.floor(Math.round(seconds) / 60)}:${String(Math.round(seconds) % 60).padStart(2, "0")}`;

function drawPlan() {
  drawArea();
  $("plan-result").replaceChildren(
    make("p", {}, `${(100 * plan.covered_share).toFixed(1)} % covered in ${clock(plan.makespan_s)} min, lines ${plan.spacing_m.toFixed(0)} m apart`),
    ...plan.vehicles.map((row) => make("div", { className: "card" },
      make("span", { className: "swatch", style: `background:${view.colourOf(flies(row.id))}` }), make("b", {}, flies(row.id)),
      make("span", { className: "quiet" }, `${row.length_m.toFixed(0)} m, ${row.photos} pictures, ${clock(row.time_s)} min${row.flights[0].start_s > 0 ? `, takes off at ${clock(row.flights[0].start_s)}` : ""}`),
      make("div", { className: "buttons" },
        make("button", { onclick: () => upload(row.id) }, "upload"),
        make("button", { onclick: () => command(flies(row.id), "start") }, "start")))),
    make("div", { className: "buttons" },
      make("button", { onclick: uploadAll }, "Upload all"), make("button", { className: "go", onclick: startAll }, "Start all")),
    ...plan.warnings.map((text) => make("p", { className: "quiet" }, text)));
}

// A plan's v1, v2, ... are the vehicles that were heard, in their order, whatever their names.
const flies = (vehicle) => plan.names[vehicle] || vehicle;
const send = (vehicle) => post(`/api/missions/${encodeURIComponent(flies(vehicle))}/upload`, { plan: plan.id, mission: vehicle });
const upload = attempt(async (vehicle) => {
  if (await confirmed(`Upload this mission to ${flies(vehicle)}? It replaces what the vehicle holds.`)) await send(vehicle);
});
const uploadAll = attempt(async () => {
  if (!(await confirmed(`Upload missions to ${plan.vehicles.length} vehicles?`))) return;
  for (const row of plan.vehicles) await send(row.id);
});
const startAll = attempt(async () => {
  const starts = plan.vehicles.map((row) => row.flights[0].start_s);
  const last = Math.max(...starts) - Math.min(...starts);
  const when = last > 0 ? `at the plan's times, the last ${clock(last)} min after the first` : "at once";
  if (!(await confirmed(`Start ${plan.vehicles.length} vehicles? They arm and take off ${when}.`))) return;
  await post(`/api/plans/${plan.id}/start`, { vehicles: plan.names });
  later();
});

// -- news ------------------------------------------------------------------------------------------------------------

let soon = null;
const later = () => { if (!soon) soon = setTimeout(() => { soon = null; refresh(); }, 1500); };

async function refresh() {
  try {
    const [layers, rows, work, legs, health, done] = await Promise.all(
      ["/api/layers", "/api/vehicles", "/api/jobs", "/api/legs", "/healthz", "/api/completions"].map(get));
    completions = done;
    drawLayers(layers);
    for (const row of rows) vehicles.set(row.id, row);
    for (const job of work) jobs.set(job.id, job);
    drawVehicles();
    drawJobs();
    view.show("legs", legs.features);
    countLegs(legs.features);
    wrong = health.problems.join("; ");
  } catch (error) {
    wrong = error instanceof TypeError ? "the daemon does not answer; is it running?" : error.message;
  }
  tellProblems();
}

function heard(event) {
  if (event.type === "layer") { view.setVersion(event.layer, event.version); later(); }
  else if (event.type === "frame" && event.outline) { outlines.set(event.vehicle, event.outline); later(); }
  else if (event.type === "vehicle") { vehicles.set(event.id, { ...vehicles.get(event.id), ...event }); view.placeVehicle(event); later(); }
  else if (event.type === "job") { jobs.set(event.id, event); drawJobs(); if (event.state === "done") later(); }
  else if (event.type === "problem" || event.type === "overload") { wrong = event.text; tellProblems(); }
  else later();
}

$("fold").onclick = () => $("panel").classList.toggle("folded");
$("fit").onclick = () => bounds && view.fit(bounds);
$("refine-all").onclick = () => refine();
$("overlays-on").onchange = (event) => view.setOverlays(event.target.checked);
$("swipe-on").onchange = (event) => view.setSwipe(event.target.checked);
$("token").value = token();
$("token").onchange = (event) => { setToken(event.target.value); refresh(); };
view.ready.then(() => { refresh(); listen(heard, (on) => $("link").classList.toggle("on", on)); drawArea(); });
window.orthoswarm = view;
