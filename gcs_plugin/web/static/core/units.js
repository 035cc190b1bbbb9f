// Numbers for people: metric or US, fixed numbers of digits so that nothing jumps.

import { settings } from "/static/core/settings.js";
import { t } from "/static/core/strings.js";

const FOOT = 0.3048;
const us = () => settings.units === "us";
const none = "–";

const DECIMAL = t("number.decimal"); // of the page's language

// A number with so many decimals; no "-0".
export const fixed = (value, digits) => value.toFixed(digits).replace(/^-(0(?:\.0*)?)$/, "$1").replace(".", DECIMAL);
const show = (value, digits, unit) => (value == null ? none : `${fixed(value, digits)} ${unit}`);

export const height = (metres) => (us() ? show(metres == null ? null : metres / FOOT, 0, "ft") : show(metres, 0, "m"));
export const speed = (m_s) => (us() ? show(m_s == null ? null : m_s * 2.236936, 0, "mph") : show(m_s, 1, "m/s"));
export const percent = (share, digits = 0) => (share == null ? none : `${fixed(100 * share, digits)} %`);
export const clock = (seconds) => {
  if (seconds == null || !Number.isFinite(seconds)) return none;
  const whole = Math.max(0, Math.round(seconds));
  return `${Math.floor(whole / 60)}:${String(whole % 60).padStart(2, "0")}`;
};
export const ageText = (seconds) => (seconds == null ? none : seconds < 10 ? `${fixed(seconds, 1)} s` : seconds < 100 ? `${Math.round(seconds)} s` : clock(seconds));

// Errors: to a centimetre.
export const error = (metres) => (us() ? show(metres / FOOT, 2, "ft") : show(metres, 2, "m"));
export function distance(metres) {
  if (metres == null) return none;
  if (us()) return metres < 1609.344 ? `${fixed(metres / FOOT, 0)} ft` : `${fixed(metres / 1609.344, 2)} mi`;
  return metres < 10 ? `${fixed(metres, 2)} m` : metres < 1000 ? `${fixed(metres, 1)} m` : `${fixed(metres / 1000, 2)} km`;
}

export function area(m2) {
  if (m2 == null) return none;
  if (us()) return m2 < 4046.86 ? `${fixed(m2 / FOOT / FOOT, 0)} ft²` : `${fixed(m2 / 4046.8564, 2)} acres`;
  return m2 < 10_000 ? `${fixed(m2, 0)} m²` : `${fixed(m2 / 10_000, 2)} ha`;
}

// A number as people type it, with a decimal point or comma; NaN for anything else. "1,000", in German "1.000", is a thousand
// to some and one to others: it is no number.
const AMBIGUOUS = new RegExp(`^[-+]?[1-9]\\d{0,2}[${t("number.groups")}]\\d{3}$`);
export function numberOf(text) {
  const words = text.trim();
  return /^[-+]?(\d+([.,]\d*)?|[.,]\d+)$/.test(words) && !AMBIGUOUS.test(words) ? Number(words.replace(",", ".")) : NaN;
}

// A number with the decimals that it has, as numberOf reads it; other texts as they are.
export const typed = (value) => (String(Number(value)) === String(value) ? String(value).replace(".", DECIMAL) : value);

// Input fields hold what the person reads; these turn it into metres and back.
export const lengthUnit = () => (us() ? "ft" : "m");
export const toMetres = (value) => (us() ? value * FOOT : value);
export const fromMetres = (metres) => (us() ? metres / FOOT : metres);

// Lengths and speeds in the station's words, which are metric.
export const inUnits = (text) => (!us() ? text : text.replace(/(\d+(?:\.\d+)?) (m\/s|km|m)(?![\w²/])/g, (_, number, unit) =>
  (unit === "m/s" ? speed(Number(number)) : unit === "km" ? distance(1000 * number) : height(Number(number)))));
