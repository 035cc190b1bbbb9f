// What comes in: everything once at the start and after each gap, then only what changes.

import { get } from "/static/core/api.js";
import { guarded } from "/static/core/guard.js";
import { changed, state } from "/static/core/store.js";
import { t } from "/static/core/strings.js";
import { aircraft, messages, MOST_TEXTS, ring, vehicle } from "/static/core/values.js";
import { announce, happened, near } from "/static/fly/alarms.js";
import { heardCommand } from "/static/fly/commands.js";

const HEALTH_MS = 5000;
const list = (value) => (Array.isArray(value) ? value : []);

const takeVehicle = guarded("a vehicle", (message, whole) => {
  const id = message?.id == null ? "" : String(message.id);
  if (!id) return;
  if (!state.vehicles.has(id) && message.state === undefined) { soon("/api/vehicles"); return; } // only what has changed of one not known yet
  state.vehicles.set(id, vehicle(message, state.vehicles.get(id), performance.now(), whole === true));
  changed("vehicles");
});
const takeTraffic = (rows) => { state.traffic = list(rows).map(aircraft).filter((row) => row.id && row.position); changed("traffic"); };
const takeJob = (job) => { if (job?.id != null) { state.jobs.set(job.id, job); changed("jobs"); } };

const READS = {
  "/api/vehicles": (rows) => list(rows).forEach((row) => takeVehicle(row, true)),
  "/api/layers": (rows) => { state.layers = list(rows); changed("layers"); },
  "/api/jobs": (rows) => list(rows).forEach(takeJob),
  "/api/legs": (body) => { state.legs = list(body?.features); changed("legs"); },
  "/api/coverage": (body) => { state.coverage = body; changed("coverage"); },
  "/api/completions": (rows) => { state.completions = list(rows); changed("completions"); },
  "/api/traffic": (rows) => takeTraffic(rows),
  "/healthz": (body) => { state.problems = list(body?.problems).map(String); changed("problems"); },
};

async function read(path) {
  try {
    guarded(path, READS[path])(await get(path));
  } catch (error) {
    if (error.kind === "http") { state.problems = [error.status === 401 ? t("app.token") : `${path}: ${error.message}`]; changed("problems"); }
  }
}
export const refresh = () => Promise.all(Object.keys(READS).map(read));

// What is asked for again after an event, at most once in two seconds.
const SOON_MS = 2000;
const due = new Set();
let timer = null;
function soon(...paths) {
  paths.forEach((path) => due.add(path));
  timer ??= setTimeout(() => { timer = null; const now = [...due]; due.clear(); now.forEach(read); }, SOON_MS);
}

const KINDS = {
  resync: () => { refresh(); changed("plan"); changed("finds-changed"); },
  vehicle: takeVehicle,
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
  job: (event) => { takeJob(event); if (event.state === "done" || event.state === "failed") soon("/api/legs", "/api/completions", "/api/vehicles", "/api/layers"); },
  coverage: () => soon("/api/coverage"),
  requests: () => soon("/api/coverage"),
  completion: () => soon("/api/completions", "/api/vehicles"),
  plan: () => changed("plan"),
  finds: () => changed("finds-changed"),
  command: heardCommand,
  alarm: announce,
  problem: () => read("/healthz"),
  overload: () => read("/healthz"),
};
export const news = guarded("the stream of events", (event) => KINDS[event.type]?.(event));

setInterval(() => { if (state.link === "live" && !document.hidden) read("/healthz"); }, HEALTH_MS);
