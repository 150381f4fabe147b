"""Style sheet of report.html: text in one column and pairs of figures, for screens and paper."""

STYLE = """
:root { --ink: #222; --soft: #666; --line: #e2e0da; --paper: #fff; --warm: #b6873a; --cool: #2f6f9f; }
* { box-sizing: border-box; }
body { font: 17px/1.55 Georgia, "Times New Roman", serif; color: var(--ink);
  background: var(--paper); max-width: 62rem; margin: 0 auto; padding: 1.5rem 1rem 4rem; }
h1, h2, h3, table, .tag { font-family: "Helvetica Neue", Helvetica, Arial, sans-serif; }
h1 { font-size: 1.7rem; line-height: 1.2; margin: .2em 0 .6em; overflow-wrap: anywhere; }
h2 { font-size: 1.2rem; margin: 2.4em 0 .7em; padding-top: .5em; border-top: 2px solid var(--ink); }
h3 { font-size: 1.02rem; margin: 0 0 .2em; }
p { max-width: 44rem; }
.said { font-size: 1.12rem; max-width: none; background: #faf6ec; margin: 1em 0;
  border-left: 5px solid var(--warm); padding: .9em 1.2em; }
.said.clear { border-color: #4a8f5a; background: #eff6f0; }
.facts, figcaption, .notes, .source { color: var(--soft); font-size: .88rem; overflow-wrap: anywhere; }
.effect { border: 1px solid var(--line); border-radius: 6px; padding: 1em 1.2em; margin: 0 0 1em; }
.effect p { margin: .2em 0 .8em; }
.effect .source { margin: .8em 0 0; }
.tag { display: inline-block; font-size: .78rem; border-radius: 1em; padding: .1em .8em;
  margin: 0 .3em .6em 0; background: #eef3f7; color: var(--cool); }
.tag.tied { background: #fbf0d9; color: #8a6116; }
.advice { border-left: 5px solid var(--cool); background: #f1f6fa; max-width: none;
  padding: .7em 1.1em; margin: .8em 0; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: .88rem; line-height: 1.35; }
td, th { padding: .34em 1.2em .34em 0; text-align: left; vertical-align: baseline;
  border-bottom: 1px solid var(--line); }
th { font-weight: 600; color: var(--soft); }
td.n, th.n { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }
tr.out td { color: #b03a12; font-weight: 600; }
figure { margin: 0 0 1.8em; break-inside: avoid; }
img { display: block; width: 100%; height: auto; }
figure.small, .pair.single { max-width: 34rem; }
.pair { display: grid; gap: .5em 1.4em;
  grid-template-columns: repeat(auto-fit, minmax(min(100%, 21rem), 1fr)); }
.pair h3 { font-size: .85rem; color: var(--soft); font-weight: 500; }
details summary { cursor: pointer; font: .9rem Helvetica, Arial, sans-serif; color: var(--cool); }
@media (max-width: 34rem) { body { font-size: 16px; } td, th { padding-right: .8em; } }
@media print {
  body { max-width: none; font-size: 11pt; padding: 0; }
  h2, h3 { break-after: avoid; }
  .said, .advice, .tag { -webkit-print-color-adjust: exact; print-color-adjust: exact; }
  .effect, tr { break-inside: avoid; }
}
"""
"""Cascading style sheet (CSS), put into the head of the page."""
