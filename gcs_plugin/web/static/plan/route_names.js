// The routes of a plan by letters: its files call them v1, v2, ..., which are names of vehicles, too.

import { t } from "/static/core/strings.js";

const LETTERS = 26;

function letters(number) {
  const before = Math.floor((number - 1) / LETTERS);
  return (before ? letters(before) : "") + String.fromCharCode(65 + ((number - 1) % LETTERS));
}

export const routeName = (part) => t("plan.route", { letter: /^v[1-9]\d*$/.test(part) ? letters(Number(part.slice(1))) : part });

// The planner's words about them.
export const inRoutes = (text) => text.replace(/\bv[1-9]\d{0,2}\b/g, routeName);
