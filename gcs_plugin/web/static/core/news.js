// What comes in: everything once at the start and after each gap, then only what changes.

import { get } from "/static/core/api.js";
import { nowMs } from "/static/core/clock.js";
import { guarded } from "/static/core/guard.js";
import { changed, state } from "/static/core/store.js";
import { t } from "/static/core/strings.js";
import { aircraft, messages, MOST_TEXTS, ring, route, vehicle } from "/static/core/values.js";
import { announce, happened, near } from "/static/fly/alarms.js";
import { heardCommand } from "/static/fly/commands.js";
import { heldRoute, inAir } from "/static/fly/need.js";

const HEALTH_MS = 5000;
const list = (value) => (Array.isArray(value) ? value : []);

const takeVehicle = guarded("a vehicle", (message, whole, at = nowMs()) => {
  const id = message?.id == null ? "" : String(message.id);
  if (!id) return;
  if (!state.vehicles.has(id) && message.state === undefined) { soon("/api/vehicles"); return; } // only what has changed of one not known yet
  const before = state.vehicles.get(id);
  const row = vehicle(message, before, at, whole === true);
  state.vehicles.set(id, row);
  if (row.route && row.route !== before?.route && !heldRoute(row)) soon("/api/routes");
  changed("vehicles");
});

// A list may come late over a slow link: it is as old as its request, and what came meanwhile is newer. What is in neither
// is not known to the station (any more): it was started again.
const meanwhile = { "/api/vehicles": [], "/api/jobs": [] };
function heard(path, take) {
  return (message) => {
    if (reading.has(path)) meanwhile[path].push([message, nowMs()]);
    take(message);
  };
}
const others = (known, rows, path) => {
  const named = new Set([...rows, ...meanwhile[path].map(([message]) => message)].map((row) => String(row?.id)));
  return [...known.keys()].filter((id) => !named.has(String(id)));
};

// One that was in the air stays as it was heard last, until it is heard again: somebody has to look for it.
const kept = (row) => row.linked && inAir(row);
function takeVehicles(rows, asked) {
  if (!Array.isArray(rows)) return;
  const unheard = (id) => state.vehicles.has(id) && kept(state.vehicles.get(id));
  const former = rows.filter((row) => row?.system == null && unheard(String(row?.id))).map((row) => String(row.id));
  for (const id of [...others(state.vehicles, rows, "/api/vehicles"), ...former]) {
    if (unheard(id)) state.vehicles.set(id, { ...state.vehicles.get(id), former: true, alarm: null, behind: "" }); // what it was warned of then may be over
    else { state.vehicles.delete(id); state.outlines.delete(id); changed("outlines"); }
  }
  rows.filter((row) => !former.includes(String(row?.id))).forEach((row) => takeVehicle(row, true, asked));
  for (const [message, at] of meanwhile["/api/vehicles"]) takeVehicle(message, false, at);
  changed("vehicles");
}
function takeJobs(rows) {
  if (!Array.isArray(rows)) return;
  for (const id of others(state.jobs, rows, "/api/jobs")) state.jobs.delete(id);
  for (const job of [...rows, ...meanwhile["/api/jobs"].map(([message]) => message)]) takeJob(job);
  changed("jobs");
}
const takeTraffic = (rows) => { state.traffic = list(rows).map(aircraft).filter((row) => row.id && row.position); changed("traffic"); };
const takeJob = (job) => { if (job?.id != null) { state.jobs.set(job.id, job); changed("jobs"); } };

const heardJob = heard("/api/jobs", takeJob);

const READS = {
  "/api/me": (body) => { state.me = body; changed("me"); },
  "/api/holds": (rows) => { state.holds = list(rows); changed("holds"); },
  "/api/vehicles": takeVehicles,
  "/api/routes": (rows) => { state.routes = list(rows).map(route); changed("routes"); },
  "/api/layers": (rows) => { state.layers = list(rows); changed("layers"); },
  "/api/jobs": takeJobs,
  "/api/legs": (body) => { state.legs = list(body?.features); changed("legs"); },
  "/api/coverage": (body) => { state.coverage = body; changed("coverage"); },
  "/api/completions": (rows) => { state.completions = list(rows); changed("completions"); },
  "/api/traffic": (rows) => takeTraffic(rows),
  "/healthz": (body) => { state.problems = list(body?.problems).map(String); changed("problems"); },
};

// One request of each path at a time: on a slow link they would pile up, and an older answer could come last. After a gap
// in the stream all are asked anew, and what was asked before it is not waited for.
let era = 0;
const reading = new Set();
const again = new Set();
async function read(path) {
  if (reading.has(path)) { again.add(path); return; }
  const [mine, asked] = [era, nowMs()];
  reading.add(path);
  if (meanwhile[path]) meanwhile[path] = [];
  try {
    const body = await get(path);
    if (mine === era) guarded(path, READS[path])(body, asked);
  } catch (error) {
    if (mine === era && error.kind === "http") { state.problems = [error.status === 401 ? t("app.token") : `${path}: ${error.message}`]; changed("problems"); }
  } finally {
    if (mine === era) reading.delete(path);
    if (mine === era && again.delete(path)) soon(path);
  }
}
export function refresh() {
  era += 1;
  reading.clear();
  again.clear();
  return Promise.all(Object.keys(READS).map(read));
}

// What is asked for again after an event, at most once in two seconds.
const SOON_MS = 2000;
const due = new Set();
let timer = null;
function soon(...paths) {
  paths.forEach((path) => due.add(path));
  timer ??= setTimeout(() => { timer = null; const now = [...due]; due.clear(); now.forEach(read); }, SOON_MS);
}

const KINDS = {
  resync: () => { refresh(); changed("plan"); changed("finds-changed"); changed("points-changed"); },
  unwelcome: () => { read("/api/me"); read("/api/vehicles"); },
  vehicle: heard("/api/vehicles", takeVehicle),
  vehicle_event: (event) => {
    const row = state.vehicles.get(String(event.vehicle));
    if (row && event.said) { row.texts = [...row.texts, ...messages([{ text: event.said, time: event.time, severity: event.severity }])].slice(-MOST_TEXTS); changed("vehicles"); }
    if (event.kind === "near" || event.kind === "apart") near(list(event.pair).map(String), event.kind === "near", event);
    else happened(event);
    soon("/api/vehicles");
  },
  frame: (event) => {
    const outline = ring(event.outline);
    if (outline.length > 2) { state.outlines.set(String(event.vehicle), outline); changed("outlines"); }
    soon("/api/vehicles");
  },
  traffic: (event) => takeTraffic(event.rows),
  layer: () => soon("/api/layers"),
  legs: () => soon("/api/legs"),
  job: (event) => { heardJob(event); if (event.state === "done" || event.state === "failed") soon("/api/legs", "/api/completions", "/api/vehicles", "/api/layers"); },
  coverage: () => soon("/api/coverage"),
  requests: () => soon("/api/coverage"),
  completion: () => soon("/api/completions", "/api/vehicles"),
  plan: () => changed("plan"),
  finds: () => changed("finds-changed"),
  points: () => changed("points-changed"),
  holds: (event) => { state.holds = list(event.rows); changed("holds"); },
  people: () => { changed("people"); soon("/api/me"); },
  log: () => changed("people"),
  command: heardCommand,
  alarm: announce,
  problem: () => read("/healthz"),
  overload: () => read("/healthz"),
};
export const news = guarded("the stream of events", (event) => KINDS[event.type]?.(event));

setInterval(() => { if (state.link === "live" && !document.hidden) read("/healthz"); }, HEALTH_MS);
