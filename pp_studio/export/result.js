"use strict";
// Keeps the look at the model, which its own page tells, in the address of this one, and loads this
// one again once version.js, which pp-cl make writes after each part, names a newer version. Pages
// that lie in a folder may read no files, but load scripts.

const version = "<!-- version -->", AGAIN = 3000;  // milliseconds
const model = document.querySelector("iframe");
let isHeld = false;
if (model) model.src = "model.html" + location.hash;
addEventListener("message", ({ source, data }) => {
  if (!model || source !== model.contentWindow) return;
  isHeld = data === "held";
  if (String(data).startsWith("#")) history.replaceState(null, "", data);
});
window.ppclVersion = (newest) => {
  if (!version) return;  // nothing is newer
  // not for an older one, which a folder that is being copied may have for a while; the last is ""
  if ((!newest || newest > version) && !isHeld) location.reload();
};
const ask = (lacks = () => {}) => {
  const script = document.createElement("script");
  script.src = `version.js?${Date.now()}`;
  script.onload = () => script.remove();
  script.onerror = () => { script.remove(); lacks(); };
  document.head.append(script);
};
ask(() => {  // this page came without its folder
  const told = document.createElement("p");
  told.className = "later";
  told.textContent = "What this page shows is not beside it: send the whole folder, or model.html "
    + "alone, which needs no other file.";
  document.querySelector("h1").after(told);
  if (model) model.remove();
});
if (version) setInterval(ask, AGAIN);
