// The viewer in notebooks, as anywidget loads it.

import { mount } from "./viewer.js";

// For anywidget: messages have numbers, by which answers find their questions.
function render({ model, el }) {
  const waiting = new Map();
  let last = 0;
  let lost = false;
  const heard = (content, buffers) => {
    const each = waiting.get(content.id);
    if (!each) return;
    waiting.delete(content.id);
    el.classList.add("jaxprt-live"); // which hides the picture that a notebook without a kernel shows
    each.resolve({ content: content.content, buffers });
  };
  const restarted = () => new Error("the kernel was restarted; run the cell again");
  const cut = () => {
    lost = true;
    for (const each of waiting.values()) each.reject(restarted());
    waiting.clear();
  };
  model.on("msg:custom", heard);
  model.on("comm_live_update", cut); // of JupyterLab, when its kernel is gone
  const ask = (content, buffers = []) =>
    new Promise((resolve, reject) => {
      if (lost) return reject(restarted());
      const id = `${Date.now()}-${Math.random()}-${++last}`;
      waiting.set(id, { resolve, reject });
      setTimeout(() => {
        if (waiting.delete(id)) reject(new Error("the kernel was restarted, or is busy"));
      }, 120000);
      model.send({ id, content }, undefined, buffers);
    });
  el.style.height = `${model.get("height")}px`;
  const close = mount(el, ask);
  return () => {
    model.off("msg:custom", heard);
    model.off("comm_live_update", cut);
    close();
  };
}
export default { render };
