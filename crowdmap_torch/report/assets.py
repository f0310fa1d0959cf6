"""Style and behaviour of report.html, inside the file so that it opens without a network."""

from __future__ import annotations

STYLE = """
:root { --ink:#27303d; --soft:#5d6876; --line:#e3e7ed; --card:#fff; --back:#f5f7fa; --faint:#b8c0cc;
  --map:#2563c9; --survey:#178a50; --before:#d9822b; --bad:#c4342d; --violet:#8a56b8; --teal:#3aa0a8;
  --bar:#fffffff2; --stripe:#f0f3f7; --hover:#f4f8ff; --ground:#fcfdfe; --mark:#e9eef6;
  --good-back:#e2f3ea; --good-ink:#12703f; --bad-back:#fbe6e4; --bad-ink:#a52a24;
  --fair-back:#fdf1e0; --fair-ink:#8a5208; --own-back:#efe6f7; --own-ink:#6d3f97; }
@media (prefers-color-scheme:dark) { :root { --ink:#e3e8ef; --soft:#9aa6b5; --line:#333d4b;
  --card:#1c232d; --back:#12171e; --faint:#55606f; --map:#7aa7f5; --survey:#4cc389; --before:#f0a457;
  --bad:#f0736b; --violet:#bd91e6; --teal:#5cc6cf; --bar:#151b23f2; --stripe:#252e3a; --hover:#263143;
  --ground:#171d26; --mark:#2c3644; --good-back:#173626; --good-ink:#7edca9; --bad-back:#431f1f;
  --bad-ink:#ff9f97; --fair-back:#3d2d15; --fair-ink:#f4bf7d; --own-back:#33264a; --own-ink:#cfaef0; } }
* { box-sizing:border-box; }
html { scroll-behavior:smooth; }
body { margin:0; background:var(--back); color:var(--ink);
  font:15px/1.5 system-ui,"Segoe UI",Roboto,"Helvetica Neue","DejaVu Sans",sans-serif; }
header { background:#1d2735; color:#fff; padding:26px 0 22px; }
header h1 { margin:0; font-size:25px; font-weight:650; letter-spacing:-.2px; }
header p { margin:4px 0 0; color:#aab6c6; }
header dl { margin:8px 0 0; display:grid; gap:2px 22px; color:#c4cedb; font-size:13.5px; }
header dl div { display:flex; gap:8px; }
header dt { color:#8f9db0; flex:0 0 82px; }
header dd { margin:0; overflow-wrap:anywhere; }
.verdict { border-radius:10px; padding:14px 18px; margin-bottom:14px; border-left:6px solid; }
.verdict strong { font-size:19px; }
.verdict ul { list-style:none; margin:8px 0 0; padding:0; color:var(--ink); }
.verdict li { margin:3px 0; padding-left:20px; text-indent:-20px; }
.verdict li b { display:inline-block; width:20px; text-indent:0; }
.verdict summary { cursor:pointer; color:var(--ink); font-size:14px; margin-top:6px; }
.verdict em { color:var(--ink); font-style:normal; font-weight:400; opacity:.85; }
.verdict.good { background:var(--good-back); color:var(--good-ink); }
.verdict.fair { background:var(--fair-back); color:var(--fair-ink); }
.verdict.poor { background:var(--bad-back); color:var(--bad-ink); }
li.good b { color:var(--good-ink); }
li.fair b { color:var(--fair-ink); }
li.poor b { color:var(--bad-ink); }
li.poor { font-weight:600; }
.charts { display:grid; grid-template-columns:repeat(auto-fill,minmax(min(100%,320px),1fr));
  gap:12px; margin-bottom:14px; align-items:start; }
.chart { margin:0; background:var(--card); border:1px solid var(--line); border-radius:10px;
  padding:12px 10px 8px; }
.chart figcaption { font-weight:600; font-size:14px; padding:0 6px 4px; }
.chart figcaption span { display:inline-block; font-weight:400; font-size:12.5px; color:var(--soft);
  margin-left:12px; white-space:nowrap; }
.chart .key { display:inline-block; width:14px; border-top:3px solid; margin:0 5px 3px 0; }
.chart .dashed { border-top-style:dotted; }
.chart svg { display:block; width:100%; height:auto; font-size:11px; }
.chart text { fill:var(--soft); }
.chart .label { fill:var(--ink); }
.chart .grid { stroke:var(--line); }
.chart .rule { stroke-width:1.3; stroke-dasharray:4 3; }
.chart .line { fill:none; stroke-linejoin:round; }
.wrap { max-width:1160px; margin:0 auto; padding:0 24px; }
nav { position:sticky; top:0; z-index:5; background:var(--bar); border-bottom:1px solid
  var(--line); }
nav .wrap { display:flex; gap:20px; overflow-x:auto; }
nav a { color:var(--soft); text-decoration:none; padding:10px 0; white-space:nowrap;
  font-size:14px; }
nav a:hover { color:var(--map); }
section { padding-top:30px; scroll-margin-top:36px; }
h2 { font-size:18px; margin:0 0 10px; }
h3 { font-size:14px; margin:18px 0 6px; }
p.note { color:var(--soft); margin:2px 0 12px; font-size:14px; max-width:80ch; }
.box { background:var(--card); border:1px solid var(--line); border-radius:10px; padding:16px; }
.box > svg { display:block; width:100%; height:auto; }
.box + .scroll,.scroll + .box { margin-top:14px; }
.cards { display:grid; grid-template-columns:repeat(auto-fill,minmax(170px,1fr)); gap:12px; }
.card { background:var(--card); border:1px solid var(--line); border-radius:10px;
  padding:12px 14px; }
.card b { display:block; font-size:25px; font-weight:650; line-height:1.25; letter-spacing:-.3px;
  font-variant-numeric:tabular-nums; }
.card b small { font-size:14px; font-weight:500; color:var(--soft); margin-left:3px; }
.card span { color:var(--soft); font-size:13px; }
.sortable td.text { white-space:nowrap; }
.sortable td.code { white-space:normal; overflow-wrap:break-word; }
table.sortable { font-size:13px; }
.sortable th,.sortable td { padding:5px 6px; }
.card i { display:block; font-style:normal; font-size:12.5px; color:var(--soft); margin-top:2px; }
.two { display:grid; grid-template-columns:1fr 1fr; gap:16px; align-items:start; }
@media (max-width:820px) { .two { grid-template-columns:1fr; } }
@media (max-width:560px) { .wrap { padding:0 12px; } .cards { grid-template-columns:1fr 1fr; }
  .card b { font-size:20px; }
  .verdict { padding:12px; } header { padding:16px 0 14px; } }
table { border-collapse:collapse; width:100%; font-size:13.5px; font-variant-numeric:tabular-nums; }
th,td { padding:5px 9px; text-align:right; border-bottom:1px solid var(--line);
  white-space:nowrap; }
th:first-child,td:first-child,.text { text-align:left; }
td.text { white-space:normal; }
td.text:first-child { min-width:11ch; }
thead th { position:sticky; top:0; background:var(--stripe); color:var(--soft); font-weight:600; }
table.sortable th { cursor:pointer; user-select:none; }
table.sortable th:hover { color:var(--map); }
th[aria-sort=ascending]::after { content:" \\2191"; }
th[aria-sort=descending]::after { content:" \\2193"; }
tbody tr:hover { background:var(--hover); }
tr.pick { cursor:pointer; }
.scroll.long { max-height:540px; }
.scroll { overflow:auto; border:1px solid var(--line); border-radius:8px;
  background:var(--card); }
.scroll tr:last-child td { border-bottom:0; }
.tag { padding:1px 8px; border-radius:9px; font-size:12.5px; background:var(--mark); color:var(--ink); }
.tag.matched { background:var(--good-back); color:var(--good-ink); }
.tag.duplicate,.tag.false { background:var(--bad-back); color:var(--bad-ink); }
.tag.control { background:var(--own-back); color:var(--own-ink); }
.bar { height:9px; border-radius:4px; background:var(--map); min-width:2px; }
.warn { border-left:4px solid var(--before); }
pre { margin:0; font:12.5px/1.5 ui-monospace,Menlo,Consolas,"DejaVu Sans Mono",monospace;
  overflow:auto; max-height:460px; }
footer { color:var(--soft); font-size:13px; padding:32px 0 40px; }
@media print { nav { display:none; } .scroll { max-height:none; } }
"""

SCRIPT = """
(function () {
  'use strict';
  document.querySelectorAll('tr.pick').forEach(function (row) {
    row.addEventListener('click', function () {
      var viewer = document.getElementById('crowdmap-viewer').viewer;
      if (viewer && viewer.chooseSign(row.dataset.id)) {
        document.getElementById('map').scrollIntoView();
      }
    });
  });
  document.querySelectorAll('table.sortable').forEach(function (table) {
    var heads = Array.from(table.tHead.rows[0].cells), body = table.tBodies[0];
    heads.forEach(function (head, column) {
      head.addEventListener('click', function () {
        var up = head.getAttribute('aria-sort') !== 'ascending';
        heads.forEach(function (other) { other.removeAttribute('aria-sort'); });
        head.setAttribute('aria-sort', up ? 'ascending' : 'descending');
        var key = function (row) { return row.cells[column].dataset.v || ''; };
        var rows = Array.from(body.rows).sort(function (a, b) {
          var p = key(a), q = key(b);
          if (p === '' || q === '') { return p === q ? 0 : p === '' ? 1 : -1; }
          var order = isNaN(p) || isNaN(q) ? p.localeCompare(q, 'en', { numeric: true }) : p - q;
          return up ? order : -order;
        });
        rows.forEach(function (row) { body.appendChild(row); });
      });
    });
  });
})();
"""
