//! The report's style sheet: system fonts, light and dark, narrow and wide, screen and paper.

pub(super) const CSS: &str = r#":root {
  color-scheme: light dark;
  --paper: #ffffff; --card: #f5f6f8; --ink: #1f2328; --quiet: #57606a; --line: #d8dee4; --link: #0b5cad;
  --good: #116329; --good-bg: #dafbe1; --caution: #7a4b00; --caution-bg: #fff3c4;
  --bad: #a40e26; --bad-bg: #ffe5e4; --not-evaluated: #424a53; --not-evaluated-bg: #eaeef2;
}
@media (prefers-color-scheme: dark) {
  :root {
    --paper: #14171a; --card: #1e2328; --ink: #e6e9ec; --quiet: #a2abb5; --line: #363d45; --link: #79b8ff;
    --good: #7ee29a; --good-bg: #12301c; --caution: #f5cf6b; --caution-bg: #362a0b;
    --bad: #ffa198; --bad-bg: #3d1618; --not-evaluated: #c4ccd4; --not-evaluated-bg: #2a3037;
  }
}
* { box-sizing: border-box; }
html { scroll-behavior: smooth; -webkit-text-size-adjust: 100%; }
@media (prefers-reduced-motion: reduce) { html { scroll-behavior: auto; } }
body {
  margin: 0; background: var(--paper); color: var(--ink);
  font: 16px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, "Noto Sans", "DejaVu Sans", sans-serif;
}
main { max-width: 68rem; margin: 0 auto; padding: 2rem 1.25rem 3rem; }
h1 { font-size: 1.9rem; line-height: 1.2; margin: 0 0 .3rem; overflow-wrap: anywhere; }
h2 { font-size: 1.3rem; line-height: 1.3; margin: 0 0 .6rem; overflow-wrap: anywhere; }
section, footer { margin-top: 2.5rem; }
p { margin: .5rem 0; max-width: 48rem; overflow-wrap: anywhere; }
a { color: var(--link); }
code { font: .88em/1.5 ui-monospace, "SF Mono", Menlo, Consolas, "DejaVu Sans Mono", monospace; overflow-wrap: anywhere; }
.subtitle { color: var(--quiet); font-size: 1.05rem; }
.assessment { display: flex; flex-wrap: wrap; gap: .3rem .9rem; align-items: baseline; max-width: none;
  margin: 1.1rem 0; padding: .7rem 1rem; border-left: .35rem solid; border-radius: .35rem; }
.assessment span { color: var(--ink); }
.assessment.good { color: var(--good); background: var(--good-bg); }
.assessment.caution { color: var(--caution); background: var(--caution-bg); }
.assessment.bad { color: var(--bad); background: var(--bad-bg); }
.assessment.not-evaluated { color: var(--not-evaluated); background: var(--not-evaluated-bg); }
.summary { display: grid; grid-template-columns: repeat(auto-fill, minmax(13.5rem, 1fr)); gap: .8rem; margin: 1.4rem 0 0; }
.summary > div { background: var(--card); border: 1px solid var(--line); border-radius: .5rem; padding: .8rem 1rem; }
.summary dt { color: var(--quiet); font-size: .9rem; }
.summary dd { margin: 0; }
.summary .value { font-size: 1.5rem; line-height: 1.3; font-weight: 600; font-variant-numeric: tabular-nums; overflow-wrap: anywhere; }
.summary .why { color: var(--quiet); font-size: .85rem; line-height: 1.4; margin-top: .25rem; }
.warnings { border: 1px solid var(--line); border-left: .35rem solid var(--caution); border-radius: .35rem; padding: .8rem 1.1rem; }
.warnings h2 { font-size: 1.05rem; }
.warnings ul { margin: 0; padding-left: 1.2rem; }
.warnings li { margin: .35rem 0; overflow-wrap: anywhere; }
.place, .hint { color: var(--quiet); }
nav { margin-top: 1.6rem; }
nav ul { display: flex; flex-wrap: wrap; gap: .3rem 1.2rem; list-style: none; margin: 0; padding: 0; }
.scroll { overflow-x: auto; margin: 1rem 0; }
table { border-collapse: collapse; min-width: 24rem; font-variant-numeric: tabular-nums; }
caption { text-align: left; color: var(--quiet); padding-bottom: .4rem; }
th, td { padding: .35rem .9rem .35rem 0; text-align: left; vertical-align: top; border-bottom: 1px solid var(--line); }
thead th { border-bottom: 2px solid var(--quiet); font-weight: 600; }
tbody th { font-weight: 500; }
.number { text-align: right; padding-left: 1rem; white-space: nowrap; }
.figures { display: grid; grid-template-columns: 1fr 1fr; gap: 1.2rem; margin-top: 1rem; }
figure { margin: 0; min-width: 0; }
figure.full { grid-column: 1 / -1; }
img { display: block; max-width: 100%; height: auto; background: #ffffff; border: 1px solid var(--line); border-radius: .35rem; }
figcaption { color: var(--quiet); font-size: .9rem; line-height: 1.45; margin-top: .4rem; overflow-wrap: anywhere; }
footer { border-top: 1px solid var(--line); padding-top: 1.2rem; }
footer h2 { font-size: 1.05rem; }
footer dl { display: grid; grid-template-columns: max-content 1fr; gap: .25rem 1.2rem; margin: 0; }
footer dt { color: var(--quiet); }
footer dd { margin: 0; min-width: 0; }
@media (max-width: 44rem) {
  .figures { grid-template-columns: 1fr; }
  footer dl { grid-template-columns: 1fr; }
  footer dd { margin-bottom: .5rem; }
}
@media print {
  :root { --paper: #fff; --card: #fff; --ink: #000; --quiet: #333; --line: #bbb; --link: #000; }
  body { font-size: 10pt; }
  main { max-width: none; padding: 0; }
  nav { display: none; }
  figure, table, .summary > div, .warnings { break-inside: avoid; }
  h2 { break-after: avoid; }
  .assessment { print-color-adjust: exact; -webkit-print-color-adjust: exact; }
}
"#;
