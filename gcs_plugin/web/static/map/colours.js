// One colour a vehicle. No green, orange or red: those say how well a leg lies on the map, and what needs attention.
// Three are Okabe and Ito's; the others were chosen to differ from all before by at least 19 (CIE 1976), also as seen
// without red, green or blue cones (Machado and others 2009).

const COLOURS = ["#0072b2", "#ddccaa", "#8800ee", "#666644", "#990066", "#56b4e9", "#8866ee", "#aadddd", "#cc79a7", "#999977"];
const taken = new Map(); // vehicle -> its place in the list

// The same on all pages, in whatever order they hear of vehicles: by the number at the end of its id, or else by its letters
// (FNV-1a), where that colour is free.
function placeOf(vehicle) {
  const number = /\d+$/.exec(vehicle);
  if (number) return (Number(number[0]) + COLOURS.length - 1) % COLOURS.length;
  let hash = 0x811c9dc5;
  for (const letter of vehicle) hash = Math.imul(hash ^ letter.codePointAt(0), 0x01000193) >>> 0;
  const used = new Set(taken.values());
  const places = COLOURS.map((_, k) => (hash + k) % COLOURS.length);
  return places.find((place) => !used.has(place)) ?? places[0];
}

// How well a leg lies on the map. A sign stands with each: at least 36 lies between the colours, seen in the same ways.
export const LEGS = { matched: { colour: "#009e73", sign: "✓" }, carried: { colour: "#e69f00", sign: "≈" }, failed: { colour: "#a3200d", sign: "✕" } };

export const FREE_LEG = "#56606b"; // where there is no map to lie on

export const colourOf = (vehicle) => {
  const key = String(vehicle);
  if (!taken.has(key)) taken.set(key, placeOf(key));
  return COLOURS[taken.get(key)];
};
