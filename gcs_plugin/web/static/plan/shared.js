// The operator's plan as the daemon keeps it: a reload, a second browser and a tablet see the same. Changes are saved one
// after the other, each until the daemon has it; what another page has changed meanwhile is merged, part by part.

import { get, request } from "/static/core/api.js";
import { notice } from "/static/core/notices.js";
import { t } from "/static/core/strings.js";

const SAVE_MS = 700;
const RETRY_MS = 3000;
let timer = null;
let there = true; // whether this daemon keeps plans
let version = null;
let kept = null; // the plan of that version
let saving = false;
let missed = false; // somebody else's change was announced during a save
let reload = () => {};

// Called with what is to be shown, when somebody else has changed the plan meanwhile.
export function whenChangedElsewhere(action) { reload = action; }

export const keptArea = () => kept?.area ?? null;

export async function loadShared() {
  const before = version;
  try {
    const body = await get("/api/plan");
    if (body?.version != null && body.version === version) return null;
    if (before != null && (isSaving() || version !== before)) return null; // changed here meanwhile: it is merged when that is saved
    version = body?.version ?? null;
    kept = body ?? null;
    return body;
  } catch (error) {
    if (error.status === 404) there = false;
    return null;
  }
}

export const isSaving = () => saving || timer != null;

// Whether what was announced can be loaded now; otherwise it is once the save has ended.
export function mayLoad() {
  missed = isSaving();
  return !missed;
}

const same = (a, b) => JSON.stringify(a ?? null) === JSON.stringify(b ?? null);
const object = (value) => (value && typeof value === "object" ? value : {});

// Mine, where theirs is as it was before: area, plan, each setting, and who flies each part. What both have changed is
// theirs. `more`: theirs lacks something of mine. `lost`: mine was changed, and theirs counts.
function merge(mine, theirs, before) {
  let lost = false;
  const pick = (key, [a, b, c]) => {
    if (same(b?.[key], c?.[key])) return a?.[key];
    lost ||= !same(a?.[key], c?.[key]) && !same(a?.[key], b?.[key]);
    return b?.[key];
  };
  const each = (sides) => Object.fromEntries([...new Set(sides.flatMap(Object.keys))].map((name) => [name, pick(name, sides)]).filter(([, value]) => value != null));
  const sides = [mine, theirs, before];
  const of = (key) => sides.map((side) => object(side?.[key]));
  const plan = pick("plan", sides) ?? null;
  const vehicles = same(mine.plan, theirs.plan) ? each(of("vehicles")) : object((same(plan, mine.plan) ? mine : theirs).vehicles);
  const whole = { area: pick("area", sides) ?? null, settings: each(of("settings")), plan, vehicles };
  return { whole, lost, more: !Object.entries(whole).every(([key, value]) => same(value, theirs[key])) };
}

// Gives what has to be sent again: what was merged, if it is more than what the daemon has.
async function send(body) {
  try {
    const answer = await request("PUT", "/api/plan", version == null ? body : { ...body, version });
    version = answer?.version ?? version;
    kept = body;
    return null;
  } catch (error) {
    const theirs = error.status === 409 ? await get("/api/plan") : null;
    if (theirs?.version == null || theirs.version === version) throw error;
    const { whole, lost, more } = merge(body, theirs, kept);
    version = theirs.version;
    kept = theirs;
    if (lost) notice("warn", t("plan.unsaved", { why: error.message }));
    reload({ ...theirs, ...whole });
    return more ? whole : null;
  }
}

// A plan that could not be sent, as the network was away, is sent once it is back. read gives the plan as it is then.
export function saveShared(read, wait_ms = SAVE_MS) {
  if (!there) return;
  clearTimeout(timer);
  timer = setTimeout(async () => {
    timer = null;
    if (saving) { saveShared(read, wait_ms); return; } // the one before has not been answered: in order
    saving = true;
    try {
      for (let body = read(); body; ) body = await send(body);
    } catch (error) {
      if (error.status === 404) there = false;
      else if (wait_ms === SAVE_MS || error.kind === "http") notice("warn", t("plan.unsaved", { why: error.message }));
      if (error.kind !== "http" && timer == null) saveShared(read, RETRY_MS);
    } finally {
      saving = false;
    }
    if (missed && timer == null) reload();
  }, wait_ms);
}
