"""The one style sheet of all pages: on wide and narrow screens, light and dark, and on paper."""

STYLE = """\
:root { color-scheme: light dark; --width: 62rem;
  --ink: #222; --paper: #fff; --line: #ddd; --head: #f4f4f4; --grey: #555;
  --link: #0b57a4; --good: #176b2c; --bad: #a11; --alarm: #a11; --warning: #d90; --information: #89a;
  --green: #e2f2e5; --on-green: #124d20; --amber: #fdf0d5; --on-amber: #6b4700; --red: #fbe0e0; --on-red: #7d0d0d;
  --chosen: #fbe3b0 }
@media screen and (prefers-color-scheme: dark) { :root { --ink: #ddd; --paper: #16181b; --line: #3a3e44;
  --head: #23262b; --grey: #a5abb3; --link: #8ab8f0; --good: #7fcf93; --bad: #f29a9a; --alarm: #e66;
  --green: #143a1e; --on-green: #c4ecce; --amber: #43330c; --on-amber: #f5dfae; --red: #4a1717; --on-red: #f7caca;
  --chosen: #5a4510 } img { filter: brightness(.87) } }
html { overflow-wrap: anywhere }
body { font: 15px/1.45 system-ui, sans-serif; max-width: var(--width); margin: 2rem auto; padding: 0 1rem;
  color: var(--ink); background: var(--paper) }
a { color: var(--link) } li { margin: .2rem 0 } code { font-size: 12px }
h2 { margin-top: 2rem; border-bottom: 1px solid var(--line) }
nav { columns: 15rem; margin: 1rem 0; padding: .5rem 1rem; background: var(--head); border-radius: 4px }
nav a { display: block }
.wide { overflow-x: auto; margin: .5rem 0 1.5rem }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: 13px; overflow-wrap: normal }
th, td { padding: .2rem .7rem; border-bottom: 1px solid var(--line); text-align: right } th { background: var(--head) }
th:first-child, td:first-child { text-align: left; position: sticky; left: 0; background: var(--paper) }
thead th:first-child { background: var(--head) }
.names th { font-weight: normal; color: var(--grey); vertical-align: top; background: var(--paper);
  white-space: nowrap }
.names td, .text { text-align: left } .names td { overflow-wrap: anywhere } .names { max-width: var(--width) }
img { max-width: 100%; background: #fff }
td.number { white-space: nowrap } td.prose { min-width: 16rem }
td.hash { overflow-wrap: anywhere; min-width: 13rem; font-family: ui-monospace, monospace; font-size: 11px }
.more-right { mask-image: linear-gradient(to left, #0000, #000 2.5rem) }
.more-below { mask-image: linear-gradient(to top, #0000, #000 2.5rem) }
.more-right.more-below { mask-image: linear-gradient(to left, #0000, #000 2.5rem),
  linear-gradient(to top, #0000, #000 2.5rem); mask-composite: intersect }
.wide:focus-visible { mask-image: none }
.pictures { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(23rem, 100%), 1fr)); gap: .8rem;
  align-items: start; margin: .5rem 0 1rem }
.pictures img { width: 100%; max-width: 29.5rem; height: auto }
/* Wide tables have the room to the right of the text. */
@media screen and (min-width: 80rem) { .wide { margin-right: calc((var(--width) - 100vw) / 2 + 1.5rem) }
  .wide img { max-width: 62rem } table:has(th:nth-child(12)) :is(th, td) { padding: .2rem .45rem } }
.long { max-height: 75vh; overflow: auto } .long thead th { position: sticky; top: 0; z-index: 1 }
.long thead th:first-child { z-index: 2 }
th button, .name { font: inherit; color: inherit; background: none; border: 0; padding: 0; cursor: pointer;
  text-align: inherit }
th button::after { content: "\\a0\\2195"; color: var(--grey); font-weight: normal }
[aria-sort=ascending] button::after { content: "\\a0\\2191" }
[aria-sort=descending] button::after { content: "\\a0\\2193" }
.name { color: var(--link); text-decoration: underline dotted } .is-chosen > * { background: var(--chosen) !important }
:focus-visible { outline: 2px solid var(--link); outline-offset: 1px }
.filter { margin: .8rem 0 -.2rem; color: var(--grey); font-size: 13px }
figure.block, .twins { margin: .5rem 0 1rem } .plot { height: min(36rem, 75vh) }
.plot.flat { height: auto; aspect-ratio: 4 / 3; max-width: 44rem } [data-drawn] > .still { display: none }
.twins .plot { width: 100%; height: auto; min-height: 15rem } .twins .full { grid-column: 1 / -1; max-width: 52rem }
.twins { --room: calc((100% - .8rem * (var(--across) - 1)) / var(--across)) }
.twins > .pictures { grid-template-columns: repeat(auto-fit, minmax(max(min(23rem, 100%), var(--room)), 1fr)) }
.twins > .pictures > :not(.full) { max-width: 34rem } figcaption { display: none; font-weight: 600; font-size: 14px }
[data-drawn] > figcaption { display: block } .twins .title { margin: 0; font-size: 13px; font-weight: 600 }
.chooser { display: flex; flex-wrap: wrap; gap: .3rem 1rem; align-items: baseline; font-size: 13px }
.chooser select, .chooser input { max-width: 11rem }
.good { color: var(--good) } .bad { color: var(--bad) }
h1 + .verdict { font-weight: 600 }
.verdict { font-size: 17px; padding: .4rem .8rem; border-radius: 4px }
.verdict.green { background: var(--green); color: var(--on-green) }
.verdict.amber { background: var(--amber); color: var(--on-amber) }
.verdict.red { background: var(--red); color: var(--on-red) }
.alarm, .warning, .information { border-left: 4px solid var(--information); padding-left: .6rem; margin: .4rem 0 }
.alarm { border-color: var(--alarm) } .warning { border-color: var(--warning) }
@media (max-width: 32rem) { th:not([aria-sort]) button::after { content: "" }
  body { margin: .5rem auto; padding: 0 .6rem } th, td { padding: .15rem .35rem }
  td.text:first-child { min-width: 7rem }
  .names th { white-space: normal } h1 { font-size: 1.4rem } .wide img { max-width: none; width: 44rem } }
@page { margin: 12mm }
@media print { :root { color-scheme: light } body { max-width: none; margin: 0; padding: 0; font-size: 10.5px }
  table { font-size: 9px } th, td { padding: .15rem .35rem } th, td.text { overflow-wrap: anywhere }
  table:has(th:nth-child(9)) { font-size: 7.5px } table:has(th:nth-child(13)) { font-size: 6.5px }
  table:has(th:nth-child(9)) :is(th, td) { padding: .1rem .2rem } .wide { overflow: visible; max-height: none }
  .filter, .chooser, .plot, .live-figure p, [data-drawn] > figcaption { display: none } th button::after { content: "" }
  [data-drawn] > .still { display: revert }
  .name { color: inherit; text-decoration: none } .is-chosen > * { background: none !important }
  th:first-child, td:first-child { position: static }
  h1, h2, h3, nav { break-after: avoid } h2 + p, h3 + p { break-after: avoid }
  thead { display: table-header-group }
  tr, img, figure, nav, .alarm, .warning, .information, .verdict { break-inside: avoid }
  p, li { orphans: 3; widows: 3 } .wide { mask-image: none !important }
  img { max-height: 105mm; width: auto; object-fit: contain } .wide img { max-height: 190mm; max-width: 100% }
  .pictures { grid-template-columns: 1fr 1fr } .verdict { font-size: 12px; print-color-adjust: exact } }
"""
