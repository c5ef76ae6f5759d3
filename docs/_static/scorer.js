// Search: pages that answer a question come before names of the reference, and these before lists.
var Scorer = {
  score: ([page, , , , score]) => score + (/^(howto|theory|tutorial)/.test(page) ? 20 : /^(benchmarks|changelog|contributing|formats)/.test(page) ? -8 : 0),
  objNameMatch: 11,
  objPartialMatch: 6,
  objPrio: { 0: 15, 1: 5, 2: -5 },
  objPrioDefault: 0,
  title: 15,
  partialTitle: 12,
  term: 5,
  partialTerm: 2,
};
