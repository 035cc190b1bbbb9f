// The operator's plan as the daemon keeps it: a reload, a second browser and a tablet see the same.

import { get, request } from "/static/core/api.js";
import { notice } from "/static/core/notices.js";
import { t } from "/static/core/strings.js";

const SAVE_MS = 700;
const RETRY_MS = 3000;
let timer = null;
let there = true; // whether this daemon keeps plans
let version = null;
let kept = null; // the area of that version
let saving = false;
let missed = false; // somebody else's change was announced during a save
let reload = () => {};

// Called when somebody else has changed the plan meanwhile: theirs stands, and is to be shown.
export function whenChangedElsewhere(action) { reload = action; }

export const keptArea = () => kept;

export async function loadShared() {
  const before = version;
  try {
    const body = await get("/api/plan");
    if (body?.version != null && body.version === version) return null;
    if (before != null && (isSaving() || version !== before)) return null; // changed here meanwhile: the daemon says whose stands
    version = body?.version ?? null;
    kept = body?.area ?? null;
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

// A plan that could not be sent, as the network was away, is sent once it is back. read gives the plan as it is then.
export function saveShared(read, wait_ms = SAVE_MS) {
  if (!there) return;
  clearTimeout(timer);
  timer = setTimeout(async () => {
    timer = null;
    saving = true;
    let outdated = false;
    try {
      const body = read();
      const answer = await request("PUT", "/api/plan", version == null ? body : { ...body, version });
      version = answer?.version ?? version;
      kept = body.area;
    } catch (error) {
      if (error.status === 404) there = false;
      else if (wait_ms === SAVE_MS || error.kind === "http") notice("warn", t("plan.unsaved", { why: error.message }));
      if (error.kind !== "http" && timer == null) saveShared(read, RETRY_MS);
      outdated = error.status === 409;
    } finally {
      saving = false;
    }
    if (outdated || (missed && timer == null)) reload(); // the version stays: without one, what is changed meanwhile would replace theirs
  }, wait_ms);
}
