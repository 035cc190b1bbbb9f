// Commands to vehicles. Each has an id and a time, and ends visibly: done, refused, not sent or unknown.

import { post } from "/static/core/api.js";
import { changed, state } from "/static/core/store.js";
import { connected, given } from "/static/core/stream.js";
import { t } from "/static/core/strings.js";
import { onLink } from "/static/fly/need.js";

const ANSWER_MS = { pause: 9_000, resume: 9_000, rtl: 9_000, return: 20_000, land: 9_000, start: 60_000, upload: 190_000, fence: 190_000 };
const MOST = 300;
const OUTCOMES = new Set(["done", "refused", "not_sent", "unknown"]);
const ALL = "all";

let numbers = 0;
export const newId = () => `page-${Date.now().toString(36)}-${(++numbers).toString(36)}-${crypto.getRandomValues(new Uint32Array(1))[0].toString(36)}`;
const nameOf = (id) => state.vehicles.get(id)?.name ?? id;

function begin(id, verb, vehicle) {
  const entry = { id, key: `${id}/${vehicle}`, verb, vehicle, name: nameOf(vehicle), at: performance.now(), outcome: "waiting", reason: "" };
  state.commands.unshift(entry);
  for (let k = state.commands.length - 1; k >= MOST; k--) if (state.commands[k].outcome !== "waiting") state.commands.splice(k, 1);
  changed("commands");
  return entry;
}

function end(entry, outcome, reason) {
  entry.outcome = OUTCOMES.has(outcome) ? outcome : "unknown";
  entry.reason = reason || t(`outcome.${entry.outcome}.why`, { name: entry.name });
  entry.ended = performance.now();
  changed("commands");
}

// What a failed request means for the command: a daemon that answered no has not sent it; silence is unknown.
function failed(entry, error, linked) {
  if (error.kind === "http" && error.status < 500) end(entry, "refused", error.message);
  else if (error.kind === "network" && !linked) end(entry, "not_sent", t("outcome.unreachable"));
  else end(entry, "unknown", t("outcome.silent", { name: entry.name }));
}

// The daemon does not carry out what it reads more than 5 s after it was given, by its own clock.
const stamp = (id) => ({ id, ...given() });

// One command to one vehicle; resolves to its entry once it has ended.
export async function command(vehicle, verb, body = {}) {
  const id = newId();
  const entry = begin(id, verb, vehicle);
  const linked = connected();
  try {
    const answer = await post(`/api/missions/${encodeURIComponent(vehicle)}/${verb}`, { ...body, ...stamp(id) }, ANSWER_MS[verb]);
    end(entry, answer?.outcome, answer?.reason);
  } catch (error) {
    failed(entry, error, linked);
  }
  return entry;
}

// One command to every vehicle on the links, at once, with an outcome for each.
export async function commandAll(verb) {
  const ids = [...state.vehicles.values()].filter(onLink).map((row) => row.id);
  const id = newId();
  const entries = new Map(ids.map((vehicle) => [vehicle, begin(id, verb, vehicle)]));
  const linked = connected();
  try {
    const answer = await post(`/api/missions/${ALL}/${verb}`, stamp(id), ANSWER_MS[verb]);
    for (const row of answer?.results ?? []) {
      const entry = entries.get(row.vehicle) ?? begin(id, verb, row.vehicle);
      entries.delete(row.vehicle);
      end(entry, row.outcome, row.reason);
    }
    for (const entry of entries.values()) end(entry, "unknown", t("outcome.silent", { name: entry.name }));
  } catch (error) {
    for (const entry of entries.values()) failed(entry, error, linked);
  }
}

// A command that another page gave, as it ended.
export function heardCommand(event) {
  const key = `${event.id}/${event.vehicle}`;
  if (!event.vehicle || state.commands.some((entry) => entry.key === key)) return;
  const entry = begin(String(event.id), String(event.command), String(event.vehicle));
  entry.elsewhere = event.by == null; // the station sends some by itself
  end(entry, event.outcome, event.reason);
}

export function forget(id) {
  state.commands = state.commands.filter((entry) => entry.outcome === "waiting" || (id && entry.id !== id));
  changed("commands");
}
