"use strict";
/* What reports and the explorer's pages share: elements, numbers as text and from text, and where a value lies among others. */

const made = (tag, properties = {}, ...children) => {
  const one = Object.assign(document.createElement(tag), properties);
  one.append(...children);
  return one;
};
const text = (value) => {
  if (typeof value === "string") return value;
  if (value === null || Number.isNaN(value)) return "none";
  const size = Math.abs(value);
  return size !== 0 && (size < 1e-3 || size >= 1e5) ? value.toExponential(3).replace(/\.?0+e/, "e") : String(Number(value.toPrecision(4)));
};
/** The same with as many digits as tell values between these ends apart. */
const textBetween = (value, [low, high]) =>
  Number.isFinite(value) && high - low < 0.05 * Math.abs(value) ? String(Number(value.toPrecision(9))) : text(value);
const withUnit = (name, unit) => (unit ? `${name} (${unit})` : name);
/** Numbers that are float32 in base64. */
const unpacked = (bytes) => new Float32Array(Uint8Array.from(atob(bytes), (one) => one.charCodeAt(0)).buffer);

/** The largest index whose value is not beyond x. */
const before = (values, x) => {
  let low = 0, high = values.length - 1;
  while (low < high) {
    const middle = (low + high + 1) >> 1;
    if (values[middle] <= x) low = middle; else high = middle - 1;
  }
  return low;
};
/** Puts a box of lines beside a place in a view, inside of it; none hides it. */
const beside = (box, lines, [x, y], view) => {
  box.hidden = !lines.length;
  box.textContent = lines.join("\n");
  const right = x + 14 + box.offsetWidth > view.clientWidth;
  box.style.left = `${Math.max(0, right ? x - 14 - box.offsetWidth : x + 14)}px`;
  box.style.top = `${Math.max(0, Math.min(y + 14, view.clientHeight - box.offsetHeight))}px`;
};
