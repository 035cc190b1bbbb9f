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
