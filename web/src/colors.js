// Colors that are told apart with any color vision: Okabe-Ito for flights, viridis for speeds.
import { Color } from "three";

const FLIGHTS = {
  dark: ["#56b4e9", "#e69f00", "#2fc49a", "#f0e442", "#f08ac0", "#ff7f45", "#b9a7ff", "#e6e6e6"],
  light: ["#0072b2", "#c26a00", "#00856a", "#8a7a00", "#b0478a", "#c03f00", "#6a4fc4", "#444b55"],
};
const VIRIDIS = ["#440154", "#482475", "#414487", "#355f8d", "#2a788e", "#21918c", "#22a884",
  "#44bf70", "#7ad151", "#bddf26", "#fde725"];
const RANGE = { dark: [0.3, 1], light: [0, 0.85] }; // the part that contrasts with the background

export const SCENE = {
  dark: { background: "#10161f", ground: "#161e2a", grid: "#263346", major: "#35465f",
    gate: "#dfe6ef", next: "#ffb000", shadow: "#05080c", ink: "#c3cfdd" },
  light: { background: "#f3f6fa", ground: "#e9eef4", grid: "#d4dce6", major: "#b9c5d3",
    gate: "#39434f", next: "#d55e00", shadow: "#8a94a1", ink: "#39434f" },
};

export const flightColor = (index, theme) => FLIGHTS[theme][index % FLIGHTS[theme].length];

export function speedColor(level, theme, target = new Color()) {
  const [low, high] = RANGE[theme];
  const place = (low + (high - low) * Math.min(Math.max(level, 0), 1)) * (VIRIDIS.length - 1);
  const i = Math.min(Math.floor(place), VIRIDIS.length - 2);
  return target.set(VIRIDIS[i]).lerp(new Color(VIRIDIS[i + 1]), place - i);
}

export function speedGradient(theme) {
  const stops = Array.from({ length: 9 }, (_, i) => `#${speedColor(i / 8, theme).getHexString()}`);
  return `linear-gradient(90deg, ${stops.join(", ")})`;
}
