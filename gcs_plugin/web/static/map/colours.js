// One colour a vehicle. No green, orange or red: those say how well a leg lies on the map, and what needs attention.
// Three are Okabe and Ito's; the others were chosen to differ from all before by at least 19 (CIE 1976), also as seen
// without red, green or blue cones (Machado and others 2009).

const COLOURS = ["#0072b2", "#ddccaa", "#8800ee", "#666644", "#990066", "#56b4e9", "#8866ee", "#aadddd", "#cc79a7", "#999977"];
const colours = new Map();

// How well a leg lies on the map. A sign stands with each: at least 36 lies between the colours, seen in the same ways.
export const LEGS = { matched: { colour: "#009e73", sign: "✓" }, carried: { colour: "#e69f00", sign: "≈" }, failed: { colour: "#a3200d", sign: "✕" } };

export const colourOf = (vehicle) => {
  if (!colours.has(vehicle)) colours.set(vehicle, COLOURS[colours.size % COLOURS.length]);
  return colours.get(vehicle);
};
