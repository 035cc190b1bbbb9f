// All words of the page, in the language that this person chose or the browser has. English first: another language is
// another catalogue with the same keys, and what it lacks is English.

import { english } from "/static/core/english.js";
import { german } from "/static/core/german.js";
import { settings } from "/static/core/settings.js";

const catalogues = { en: english, de: german };
export const LANGUAGES = Object.keys(catalogues);
const browser = navigator.language.slice(0, 2).toLowerCase();
const language = [settings.language, browser].find((name) => LANGUAGES.includes(name)) ?? "en";
const words = catalogues[language];
document.documentElement.lang = language;

// The words of a key, with {name} replaced, and {name|one|many} by what goes with the number; an unknown key shows itself.
export const t = (key, values = {}) => (words[key] ?? english[key] ?? key)
  .replace(/\{(\w+)\|([^|}]*)\|([^}]*)\}/g, (whole, name, one, many) => (Number(values[name]) === 1 ? one : many)).replace(/\{(\w+)\}/g, (whole, name) => String(values[name] ?? ""));
