// One colour a vehicle. No green, orange or red: those say how well a leg lies on the map, and what needs attention.

const COLOURS = ["#1c64b0", "#8a3ec4", "#0c8599", "#d6409f", "#3b4cc0", "#7a5c3a", "#56606b", "#4d7ea8", "#a14a8b", "#2f7f8f", "#6a51a3", "#8c6d31"];
const colours = new Map();

export const colourOf = (vehicle) => {
  if (!colours.has(vehicle)) colours.set(vehicle, COLOURS[colours.size % COLOURS.length]);
  return colours.get(vehicle);
};
