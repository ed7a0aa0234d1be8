// The page: flights in the element #data.
import { Viewer } from "./viewer.js";

const data = JSON.parse(document.getElementById("data").textContent);
window.quadjax = { viewer: new Viewer(document.getElementById("app"), data) };
