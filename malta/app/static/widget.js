// The page in a notebook: documents go as messages of the widget, news come as such.

import { mount } from "./app.js";

function messages(model) {
  const waiting = new Map();
  let count = 0, hear = () => {};
  model.on("msg:custom", (message) => {
    if (message.news) hear(message.news);
    else { waiting.get(message.id)?.(message.body); waiting.delete(message.id); }
  });
  return {
    ask: (body) => new Promise((resolve) => { count += 1; waiting.set(count, resolve); model.send({ id: count, body }); }),
    listen: (heard) => { hear = heard; },
  };
}

function render({ model, el }) {
  const root = document.createElement("div");
  root.style.height = `${model.get("height")}px`;
  el.append(root);
  mount(root, messages(model));
}

export default { render };
