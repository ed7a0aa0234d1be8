// Keys of the viewer.
import { VIEWS } from "./cameras.js";
import { theme } from "./dom.js";

export function listen(viewer, step) {
  const { clock } = viewer;
  const keys = {
    " ": () => clock.play(!clock.playing),
    ArrowLeft: (event) => clock.step(event.shiftKey ? -0.5 : -step),
    ArrowRight: (event) => clock.step(event.shiftKey ? 0.5 : step),
    ArrowUp: () => clock.faster(1),
    ArrowDown: () => clock.faster(-1),
    n: () => viewer.select(viewer.selected + 1),
    N: () => viewer.select(viewer.selected - 1),
    d: () => viewer.magnify(),
    l: () => viewer.toggleLabels(),
    f: () => viewer.toggleSight(),
    p: () => viewer.togglePanel(),
    t: () => theme.toggle(),
    h: () => viewer.overlay.toggleHelp(),
    "?": () => viewer.overlay.toggleHelp(),
    r: () => viewer.setView(viewer.cameras.view),
    0: () => clock.seek(0),
    Home: () => clock.seek(0),
    End: () => clock.seek(clock.end),
    Escape: () => { viewer.overlay.toggleHelp(true); },
  };
  VIEWS.forEach((view, index) => { keys[index + 1] = () => viewer.setView(view); });
  window.addEventListener("keydown", (event) => {
    const typing = ["INPUT", "SELECT", "TEXTAREA"].includes(event.target.tagName);
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (typing && event.target.type !== "range") return;
    if (event.target.tagName === "BUTTON" && event.key === " ") event.target.blur();
    const action = keys[event.key];
    if (!action) return;
    event.preventDefault();
    action(event);
  });
}
