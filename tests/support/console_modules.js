// Lets Node load the console's modules as a browser does: addresses below /console/static/ are files of the checkout,
// three.js is what the pages get from NiceGUI. What a browser has beside it is a store of text.
import { registerHooks } from "node:module";
import { pathToFileURL } from "node:url";

const STATIC = pathToFileURL(`${process.env.CONSOLE_STATIC}/`).href;
const SCENE = pathToFileURL(process.env.SCENE_MODULE).href;

registerHooks({
  resolve(specifier, context, next) {
    if (specifier === "nicegui-scene") return next(SCENE, context);
    return next(specifier.replace(/^\/console\/static\//, STATIC), context);
  },
});

class Store {
  #texts = new Map();
  getItem(name) {
    return this.#texts.get(name) ?? null;
  }
  setItem(name, value) {
    this.#texts.set(name, String(value));
  }
  removeItem(name) {
    this.#texts.delete(name);
  }
}

for (const name of ["localStorage", "sessionStorage"])
  Object.defineProperty(globalThis, name, { value: new Store(), configurable: true });
Object.defineProperty(globalThis, "navigator", { value: { languages: ["en-GB"] }, configurable: true });
globalThis.location = new URL("http://127.0.0.1:8600/captures");
