// The page in a browser: documents go by fetch, news by a question that waits for them.

import { mount } from "./app.js";

const token = new URLSearchParams(location.search).get("token") ?? "";

async function ask(body) {
  const answer = await fetch("/ask", { method: "POST", headers: { "Content-Type": "application/json", "X-Malta-Token": token }, body: JSON.stringify(body) });
  if (!answer.ok) throw new Error(await answer.text());
  return answer.json();
}

async function listen(hear, page) {
  for (let after = 0, failures = 0; failures < 5; ) {
    try {
      const found = await ask({ ask: "news", after, page });
      if (found.lost) { hear({ kind: "lost", text: found.lost }); return; }
      after = found.after;
      failures = 0;
      found.news.forEach(hear);
    } catch {
      failures += 1;
      await new Promise((resume) => setTimeout(resume, 300 * failures));
    }
  }
  hear({ kind: "gone" });
}

const root = document.getElementById("page");
document.addEventListener("keydown", (event) => { if (!root.contains(event.target)) root.dispatchEvent(new KeyboardEvent("keydown", event)); });
mount(root, { ask, listen });
