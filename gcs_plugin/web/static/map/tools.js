// Which tool has the map's clicks: one at a time, Escape puts it down.

import { setAttribute } from "/static/core/dom.js";
import { map } from "/static/map/map.js";

export const tool = { active: null };
const ends = new Map();

export function takeTool(name, end) {
  if (tool.active && tool.active !== name) ends.get(tool.active)?.();
  tool.active = name;
  ends.set(name, end);
  map.getCanvas().style.cursor = "crosshair";
  setAttribute(map.getContainer(), "data-tool", name);
  map.doubleClickZoom.disable();
}

export function dropTool(name) {
  if (tool.active !== name) return;
  tool.active = null;
  map.getCanvas().style.cursor = "";
  setAttribute(map.getContainer(), "data-tool", null);
  setTimeout(() => map.doubleClickZoom.enable(), 400);
}

document.addEventListener("keydown", (event) => {
  if (event.key === "Escape" && tool.active) ends.get(tool.active)?.();
});
