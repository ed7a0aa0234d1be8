// The page: data in the element #data, or, of a live page, from the server that it came from.
import { Viewer } from "./viewer.js";

const data = JSON.parse(document.getElementById("data").textContent);
const root = document.getElementById("app");
window.quadjax = { viewer: new Viewer(root, data, { play: true, view: data.view }) };
