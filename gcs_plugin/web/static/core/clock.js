// Time that goes on while the tablet sleeps: performance.now() stands still then, and what is old would look new.

const JUMP_MS = 1000; // less is the wall clock being adjusted

let slept_ms = 0;
let ahead_ms = Date.now() - performance.now();

// Milliseconds since the page was opened. A wall clock that somebody sets forward counts as sleep, too: what is shown then
// counts as old until the next news, within a second. Not for the times of commands.
export function nowMs() {
  const steady = performance.now();
  const ahead = Date.now() - steady;
  if (ahead - ahead_ms > JUMP_MS) slept_ms += ahead - ahead_ms;
  ahead_ms = ahead;
  return steady + slept_ms;
}

// By this device's clock, with its zone: others write in their own, or in UTC. With the date if it is not today.
const east_min = (time_ms) => -new Date(time_ms).getTimezoneOffset();
const local = (time_ms) => new Date(time_ms + east_min(time_ms) * 60_000).toISOString();
function zone(time_ms) {
  const minutes = Math.abs(east_min(time_ms));
  const part = minutes % 60 ? `:${String(minutes % 60).padStart(2, "0")}` : "";
  return minutes ? `UTC${east_min(time_ms) < 0 ? "-" : "+"}${Math.floor(minutes / 60)}${part}` : "UTC";
}
export function timeOfDay(time_ms, { seconds = false } = {}) {
  if (!Number.isFinite(time_ms) || Math.abs(time_ms) > 8e15) return ""; // no date is further away
  const [day, time] = [local(time_ms).slice(0, 10), local(time_ms).slice(11, seconds ? 19 : 16)];
  return `${day === local(Date.now()).slice(0, 10) ? "" : `${day} `}${time} ${zone(time_ms)}`;
}
