// The latest picture of the selected vehicle, as it arrives; asked for once in some seconds at most.

import { picture } from "/static/core/api.js";
import { timeOfDay } from "/static/core/clock.js";
import { make, setHidden } from "/static/core/dom.js";
import { guarded } from "/static/core/guard.js";
import { state, subscribe } from "/static/core/store.js";
import { t } from "/static/core/strings.js";

const PAUSE_MS = 3000;

export function latestPicture() {
  const image = make("img", { alt: "" });
  const words = make("figcaption", {});
  const box = make("figure", { class: "latest", hidden: true }, image, words);
  let shown = "";
  let busy = false;
  image.onload = () => URL.revokeObjectURL(image.src);
  const look = guarded("latest picture", async () => {
    const id = state.selected;
    const row = state.vehicles.get(id);
    if (row?.last_seq == null) { setHidden(box, true); return; }
    const key = `${id}/${row.last_seq}`;
    if (busy || key === shown) return;
    busy = true;
    try {
      const url = await picture(`/api/frames/${row.last_seq}/view`);
      if (state.selected !== id) return;
      image.src = url;
      image.alt = words.textContent = t("details.picture.of", { name: row.name, time: row.last_frame ? timeOfDay(Date.parse(row.last_frame), { seconds: true }) : "–" });
      setHidden(box, false);
      shown = key;
    } catch { /* the next one comes */ } finally {
      setTimeout(() => { busy = false; look(); }, PAUSE_MS);
    }
  });
  subscribe("vehicles selected", "latest picture", () => { if (!shown.startsWith(`${state.selected}/`)) setHidden(box, true); look(); });
  return box;
}
