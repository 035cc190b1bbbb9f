// What the page knows, and who wants to hear of changes. Changes are gathered: listeners run at most ten times a second.

import { guarded } from "/static/core/guard.js";

export const state = {
  vehicles: new Map(), // id -> row as core/values.js cleans it
  jobs: new Map(), // id -> job
  layers: [], // rows of /api/layers
  legs: [], // GeoJSON features
  routes: [], // what vehicles hold, as core/values.js cleans it
  trust: null, // /api/trust
  change: null, // /api/change
  coverage: null, // /api/coverage
  completions: [],
  outlines: new Map(), // vehicle -> ring of the last picture
  problems: [], // texts of /healthz
  commands: [], // newest first; fly/commands.js
  alarms: new Map(), // key -> alarm; fly/alarms.js
  finds: [],
  points: [],
  me: null, // who this page is to the station: /api/me
  holds: [], // which pilot has which vehicle: /api/holds
  traffic: [], // other aircraft, as core/values.js cleans them
  link: "connecting", // connecting, live, late, lost
  silent_s: 0,
  selected: null, // id of a vehicle
};

const GATHER_MS = 100;
const listeners = new Map();
const dirty = new Set();
let timer = null;

export function subscribe(topics, name, work) {
  const run = guarded(name, work);
  for (const topic of topics.split(" ")) {
    if (!listeners.has(topic)) listeners.set(topic, []);
    listeners.get(topic).push(run);
    changed(topic); // what came before somebody listened is heard as well
  }
  return run;
}

export function changed(topic) {
  dirty.add(topic);
  timer ??= setTimeout(flush, GATHER_MS);
}

function flush() {
  timer = null;
  const topics = [...dirty];
  dirty.clear();
  const due = new Set(topics.flatMap((topic) => listeners.get(topic) ?? []));
  for (const run of due) run();
}

export function select(id) {
  if (state.selected === id) return;
  state.selected = id;
  changed("selected");
}
