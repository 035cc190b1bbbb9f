// Distance and area: tap points; the figures stand beside the tool and change with each.

import { button, make, setText } from "/static/core/dom.js";
import { onSettings } from "/static/core/settings.js";
import { t } from "/static/core/strings.js";
import * as units from "/static/core/units.js";
import { areaOf, lengthOf } from "/static/map/geodesy.js";
import { feature, map, show } from "/static/map/map.js";
import { dropTool, takeTool, tool } from "/static/map/tools.js";

export function measurePanel() {
  let points = [];
  const result = make("p", { role: "status" });
  const start = button(t("measure.start"), () => (tool.active === "measure" ? stop() : begin()));
  const undo = button(t("measure.undo"), () => { points.pop(); draw(); });
  const clear = button(t("measure.clear"), () => { points = []; draw(); });
  const begin = () => { points = []; takeTool("measure", stop); setText(start, t("measure.stop")); draw(); };
  function stop() { dropTool("measure"); setText(start, t("measure.start")); }
  const draw = () => {
    show("measure", [...(points.length > 1 ? [feature("LineString", points)] : []), ...(points.length > 2 ? [feature("Polygon", [[...points, points[0]]])] : [])]);
    const closed = [...points, points[0]];
    setText(result, points.length < 2 ? (tool.active === "measure" ? t("measure.hint") : "")
      : [t("measure.distance", { d: units.distance(lengthOf(points)) }), points.length > 2 ? t("measure.area", { a: units.area(areaOf(points)), p: units.distance(lengthOf(closed)) }) : ""].join(" "));
  };
  map.on("click", (event) => {
    if (tool.active !== "measure") return;
    points.push([event.lngLat.lng, event.lngLat.lat]);
    draw();
  });
  onSettings(draw);
  return make("section", {}, make("h2", {}, t("measure.title")), make("div", { class: "row wrap" }, start, undo, clear), result);
}
