// Elements. Text from files is only ever set as text, never as HTML.
export function el(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name === "text") element.textContent = value;
    else if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else if (value !== false && value !== undefined) element.setAttribute(name, value);
  }
  element.append(...children.filter((child) => child !== null && child !== undefined));
  return element;
}

export const seconds = (value, digits = 2) => (Number.isFinite(value) ? value.toFixed(digits) : "–");

// The theme that the page shows: chosen by the user, or the system's.
export const theme = {
  onChange: () => {},
  get current() {
    const system = matchMedia("(prefers-color-scheme: light)").matches ? "light" : "dark";
    return document.documentElement.dataset.theme || system;
  },
  toggle() {
    document.documentElement.dataset.theme = theme.current === "dark" ? "light" : "dark";
    theme.onChange(theme.current);
  },
};
matchMedia("(prefers-color-scheme: light)").addEventListener("change",
  () => theme.onChange(theme.current));

// Two-dimensional context of a canvas with as many pixels as the screen shows.
export function sharp(canvas) {
  const ratio = Math.min(window.devicePixelRatio || 1, 2);
  const [width, height] = [canvas.clientWidth, canvas.clientHeight];
  if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
  }
  const context = canvas.getContext("2d", { willReadFrequently: true });
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, width, height);
  return { context, width, height };
}

export const style = (name) => getComputedStyle(document.documentElement).getPropertyValue(name);
