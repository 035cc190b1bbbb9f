// A picture that the station makes, as a layer over the imagery, and the news of it when a job has written another one.

import { get } from "/static/core/api.js";
import { changed, state, subscribe } from "/static/core/store.js";
import { addInOrder, map } from "/static/map/map.js";

// Show a picture (`url`, `coordinates` of its corners), in place of the one that the layer had.
export function showPicture(id, picture, paint) {
  if (map.getSource(id)) { map.getSource(id).updateImage(picture); return; }
  map.addSource(id, { type: "image", ...picture });
  addInOrder({ id, type: "raster", source: id, paint: { "raster-fade-duration": 0, "raster-resampling": "nearest", ...paint }, layout: { visibility: "none" } }); // until it is known whether it is wanted
}

// Read state[key] from /api/key each time that a job of a kind is done.
export function readAfter(kind, key) {
  let asked = 0; // the job after which it was asked for
  subscribe("jobs ready", `news of ${key}`, async () => {
    const newest = Math.max(0, ...[...state.jobs.values()].filter((job) => job.kind === kind && job.state === "done").map((job) => job.id));
    if (newest === asked) return;
    asked = newest;
    try { state[key] = await get(`/api/${key}`); } catch { state[key] = null; }
    changed(key);
  });
}
