# SPDX-License-Identifier: Apache-2.0
"""The look of ``report.html``."""

STYLE = """
:root { --line: #d9dce1; --soft: #f5f6f8; --ink: #1d232b; --accent: #0b5fa5; }
* { box-sizing: border-box; }
body { font: 15px/1.5 system-ui, sans-serif; color: var(--ink); margin: 0 auto; padding: 1rem;
  max-width: 82rem; }
h1 { font-size: 1.5rem; margin: .2rem 0 .6rem; } h2 { font-size: 1.15rem; margin: 2rem 0 .5rem; }
.verdict { font-size: 1.05rem; padding: .5rem .8rem; border-left: .35rem solid #009e73;
  background: var(--soft); }
.verdict.none { border-color: #d55e00; } .warning { background: #fdf0d5; padding: .35rem .8rem;
  margin: .4rem 0; }
.cards { display: flex; flex-wrap: wrap; gap: .6rem; margin: .8rem 0; }
.cards div { border: 1px solid var(--line); border-radius: .4rem; padding: .35rem .8rem; }
.cards b { display: block; font-size: 1.15rem; font-variant-numeric: tabular-nums; }
.cards span { color: #5a6472; font-size: .85rem; }
.view { display: grid; grid-template-columns: minmax(0, 1fr) 18.5rem; gap: 1rem; }
@media (max-width: 56rem) { .view { grid-template-columns: minmax(0, 1fr); } }
.frame { position: relative; }
#map { width: 100%; height: min(82vh, 46rem); display: block; cursor: crosshair;
  touch-action: none; }
.buttons { position: absolute; top: .5rem; right: .5rem; display: flex; gap: .25rem; }
button { font: inherit; background: #fff; border: 1px solid #98a1ad; border-radius: .3rem;
  min-width: 2rem; cursor: pointer; }
fieldset { border: 1px solid var(--line); border-radius: .4rem; margin: 0 0 .7rem;
  min-width: 0; padding: .3rem .6rem .5rem; }
legend { font-weight: 600; padding: 0 .3rem; } fieldset label { display: block; cursor: pointer;
  white-space: nowrap; overflow: hidden; text-overflow: ellipsis; }
#values td { white-space: nowrap; } #values th, #values td { padding: .12rem .2rem; }
tbody td:first-child { white-space: nowrap; }
#legend { min-height: 2.6rem; } #legend canvas { width: 100%; height: 36px; display: block; }
#legend div { display: flex; align-items: center; gap: .5rem; }
#legend i { width: 1rem; height: 1rem; border: 1px solid #666; } #legend b { margin-left: auto;
  font-weight: 400; font-variant-numeric: tabular-nums; }
#values { width: 100%; } #values th { font-weight: 400; color: #5a6472; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { padding: .15rem .6rem; text-align: right; border-bottom: 1px solid var(--line);
  vertical-align: top; }
th:first-child, td.text, th:last-child { text-align: left; }
.scroll { overflow-x: auto; } tr[data-site] { cursor: pointer; }
tr[data-site]:hover { background: #e8f1fa; } tr.changed td { background: #eef6ec; }
.plain td { text-align: left; }
.charts { display: grid; grid-template-columns: repeat(auto-fit, minmax(24rem, 1fr)); gap: 1rem; }
.charts canvas { width: 100%; height: 15rem; display: block; }
.columns { display: grid; grid-template-columns: repeat(auto-fit, minmax(24rem, 1fr)); gap: 2rem; }
.bar { display: inline-block; height: .6rem; background: #0072b2; }
.note { color: #5a6472; font-size: .9rem; } #legend .note { margin: .3rem 0 0; line-height: 1.3; }
input[type=search] { font: inherit; width: 18rem; }
@media print { .buttons, fieldset { display: none; } .view { grid-template-columns: 1fr; } }
"""
