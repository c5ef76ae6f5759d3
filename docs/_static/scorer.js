// Search: pages whose title has the word, then pages that answer a question, then names of the reference, lists last.
const wanted = (new URLSearchParams(window.location.search).get("q") || "").toLowerCase();
var Scorer = {
  score: ([page, title, anchor, , score]) =>
    score + (/^(howto|theory|tutorial|install|elsewhere)/.test(page) ? 20 : /^(benchmarks|changelog|contributing|formats)/.test(page) ? -8 : 0)
    + (!anchor && wanted && title.toLowerCase().includes(wanted) ? 10 : 0),
  objNameMatch: 11,
  objPartialMatch: 6,
  objPrio: { 0: 15, 1: 5, 2: -5 },
  objPrioDefault: 0,
  title: 15,
  partialTitle: 12,
  term: 5,
  partialTerm: 2,
};
