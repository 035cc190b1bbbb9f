// All words of the page. English first: another language is another catalogue with the same keys.

import { english } from "/static/core/english.js";

const catalogues = { en: english };
const words = catalogues[document.documentElement.lang] ?? english;

// The words of a key, with {name} replaced, and {name|one|many} by what goes with the number; an unknown key shows itself.
export const t = (key, values = {}) => (words[key] ?? english[key] ?? key)
  .replace(/\{(\w+)\|([^|}]*)\|([^}]*)\}/g, (whole, name, one, many) => (Number(values[name]) === 1 ? one : many)).replace(/\{(\w+)\}/g, (whole, name) => String(values[name] ?? ""));
