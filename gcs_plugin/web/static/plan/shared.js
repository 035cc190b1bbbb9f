// The operator's plan as the daemon keeps it: a reload, a second browser and a tablet see the same.

import { get, request } from "/static/core/api.js";
import { notice } from "/static/core/notices.js";
import { t } from "/static/core/strings.js";

const SAVE_MS = 700;
const RETRY_MS = 3000;
let timer = null;
let there = true; // whether this daemon keeps plans
let version = null;
let saving = false;
let reload = () => {};

// Called when somebody else has changed the plan meanwhile: theirs stands, and is to be shown.
export function whenChangedElsewhere(action) { reload = action; }

export async function loadShared() {
  try {
    const body = await get("/api/plan");
    if (body?.version != null && body.version === version) return null;
    version = body?.version ?? null;
    return body;
  } catch (error) {
    if (error.status === 404) there = false;
    return null;
  }
}

export const isSaving = () => saving || timer != null;

// A plan that could not be sent, as the network was away, is sent once it is back.
export function saveShared(body, wait_ms = SAVE_MS) {
  if (!there) return;
  clearTimeout(timer);
  timer = setTimeout(async () => {
    timer = null;
    saving = true;
    let outdated = false;
    try {
      const answer = await request("PUT", "/api/plan", version == null ? body : { ...body, version });
      version = answer?.version ?? version;
    } catch (error) {
      if (error.status === 404) there = false;
      else if (wait_ms === SAVE_MS) notice("warn", t("plan.unsaved", { why: error.message }));
      if (error.kind !== "http" && timer == null) saveShared(body, RETRY_MS);
      outdated = error.status === 409;
    } finally {
      saving = false;
    }
    if (outdated) {
      version = null;
      reload();
    }
  }, wait_ms);
}
