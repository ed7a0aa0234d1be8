// The page: flights in the element #data, or a live page that asks its server.
import { Dashboard } from "./dashboard.js";
import { Viewer } from "./viewer.js";

const data = JSON.parse(document.getElementById("data").textContent);
const root = document.getElementById("app");
window.quadjax = {};
if (data.live) window.quadjax.dashboard = new Dashboard(root, data.live);
else window.quadjax.viewer = new Viewer(root, data, { play: true, view: data.view });
