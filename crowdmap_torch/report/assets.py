"""Style and behaviour of report.html, inside the file so that it opens without a network."""

from __future__ import annotations

STYLE = """
:root { --ink:#27303d; --soft:#66717f; --line:#e3e7ed; --card:#fff; --back:#f5f7fa;
  --map:#2563c9; --survey:#178a50; --before:#d9822b; --bad:#c4342d; }
* { box-sizing:border-box; }
html { scroll-behavior:smooth; }
body { margin:0; background:var(--back); color:var(--ink);
  font:15px/1.5 system-ui,"Segoe UI",Roboto,"Helvetica Neue","DejaVu Sans",sans-serif; }
header { background:#1d2735; color:#fff; padding:26px 0 22px; }
header h1 { margin:0; font-size:25px; font-weight:650; letter-spacing:-.2px; }
header p { margin:4px 0 0; color:#aab6c6; }
.wrap { max-width:1160px; margin:0 auto; padding:0 24px; }
nav { position:sticky; top:0; z-index:5; background:#fffffff2; border-bottom:1px solid
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
table.sortable { font-size:13px; }
.sortable th,.sortable td { padding:5px 6px; }
.card i { display:block; font-style:normal; font-size:12.5px; color:var(--soft); margin-top:2px; }
.two { display:grid; grid-template-columns:1fr 1fr; gap:16px; align-items:start; }
@media (max-width:820px) { .two { grid-template-columns:1fr; } }
table { border-collapse:collapse; width:100%; font-size:13.5px; font-variant-numeric:tabular-nums; }
th,td { padding:5px 9px; text-align:right; border-bottom:1px solid var(--line);
  white-space:nowrap; }
th:first-child,td:first-child,.text { text-align:left; }
td.text { white-space:normal; }
thead th { position:sticky; top:0; background:#f0f3f7; color:var(--soft); font-weight:600; }
table.sortable th { cursor:pointer; user-select:none; }
table.sortable th:hover { color:var(--map); }
th[aria-sort=ascending]::after { content:" \\2191"; }
th[aria-sort=descending]::after { content:" \\2193"; }
tbody tr:hover { background:#f4f8ff; }
tr.pick { cursor:pointer; }
.scroll.long { max-height:540px; }
.scroll { overflow:auto; border:1px solid var(--line); border-radius:8px;
  background:#fff; }
.scroll tr:last-child td { border-bottom:0; }
.tag { padding:1px 8px; border-radius:9px; font-size:12.5px; background:#e9eef6; color:#3d4a5c; }
.tag.matched { background:#e2f3ea; color:#12703f; }
.tag.duplicate,.tag.false { background:#fbe6e4; color:#a52a24; }
.tag.control { background:#efe6f7; color:#6d3f97; }
.bar { height:9px; border-radius:4px; background:var(--map); min-width:2px; }
.warn { border-left:4px solid var(--before); }
pre { margin:0; font:12.5px/1.5 ui-monospace,Menlo,Consolas,"DejaVu Sans Mono",monospace;
  overflow:auto; max-height:460px; }
.map { position:relative; padding:0; overflow:hidden; }
.map > svg:first-child { display:block; width:100%; height:540px; background:#fcfdfe; cursor:grab;
  touch-action:none; }
.map > svg:first-child:active { cursor:grabbing; }
.map g path { vector-effect:non-scaling-stroke; fill:none; }
.map g circle { r:calc(var(--k) * var(--r) * 1px); vector-effect:non-scaling-stroke; }
.map g circle:hover { r:calc(var(--k) * var(--r) * 1.5px); }
.map .layers { position:absolute; left:12px; top:12px; background:#ffffffee; padding:8px 12px;
  border:1px solid var(--line); border-radius:8px; font-size:13px; }
.map .layers label { display:block; cursor:pointer; }
.map .layers em { display:inline-block; width:16px; height:4px; border-radius:2px;
  margin:0 7px 3px 4px; }
.map .buttons { position:absolute; right:12px; top:12px; display:flex; gap:6px; }
.map button { border:1px solid var(--line); background:#fff; border-radius:7px; height:32px;
  min-width:32px; font:inherit; cursor:pointer; }
.map .scale { position:absolute; right:14px; bottom:12px; border-bottom:2px solid var(--ink);
  border-left:2px solid var(--ink); border-right:2px solid var(--ink); height:7px;
  pointer-events:none; }
.map .scale span { position:absolute; left:0; right:0; bottom:8px; text-align:center;
  font-size:12px; white-space:nowrap; }
.map .north { height:34px; width:34px; font:600 11px sans-serif; position:absolute; right:18px;
  top:56px; fill:var(--ink);
  pointer-events:none; }
.map .tip { position:absolute; left:12px; bottom:10px; font-size:13px; color:var(--soft);
  background:#ffffffdd; padding:1px 6px; border-radius:5px; pointer-events:none; }
footer { color:var(--soft); font-size:13px; padding:32px 0 40px; }
@media print { nav,.map .buttons,.map .layers { display:none; } .scroll { max-height:none; } }
"""

SCRIPT = """
(function () {
  'use strict';
  var map = document.querySelector('.map');
  if (map) {
    var svg = map.querySelector('svg'), tip = map.querySelector('.tip');
    var scale = map.querySelector('.scale');
    var home = svg.getAttribute('viewBox').split(' ').map(Number), box = home.slice();
    var show = function () {
      svg.setAttribute('viewBox', box.join(' '));
      var perPixel = Math.max(box[2] / svg.clientWidth, box[3] / svg.clientHeight);
      svg.style.setProperty('--k', perPixel);
      var power = Math.pow(10, Math.floor(Math.log10(120 * perPixel)));
      var steps = [5, 2, 1], length = power;
      for (var k = 0; k < 3; k++) {
        if (steps[k] * power <= 120 * perPixel) { length = steps[k] * power; break; }
      }
      scale.style.width = (length / perPixel) + 'px';
      scale.firstElementChild.textContent = length >= 1000 ? length / 1000 + ' km' : length + ' m';
    };
    var world = svg.querySelector('#world');
    var at = function (event, element) {
      var point = new DOMPoint(event.clientX, event.clientY);
      return point.matrixTransform((element || svg).getScreenCTM().inverse());
    };
    var zoom = function (factor, x, y) {
      factor = Math.min(Math.max(factor, 2 / box[2]), 4 * home[2] / box[2]);
      box = [x + (box[0] - x) * factor, y + (box[1] - y) * factor,
             box[2] * factor, box[3] * factor];
      show();
    };
    svg.addEventListener('wheel', function (event) {
      event.preventDefault();
      var p = at(event);
      zoom(Math.exp(event.deltaY * 0.0015), p.x, p.y);
    }, { passive: false });
    var from = null;
    svg.addEventListener('pointerdown', function (event) {
      from = at(event);
      svg.setPointerCapture(event.pointerId);
    });
    svg.addEventListener('pointermove', function (event) {
      var p = at(event);
      if (from) { box[0] += from.x - p.x; box[1] += from.y - p.y; show(); }
      p = at(event, world);
      tip.textContent = 'east ' + p.x.toFixed(1) + ' m, north ' + (-p.y).toFixed(1) + ' m';
    });
    ['pointerup', 'pointercancel'].forEach(function (name) {
      svg.addEventListener(name, function () { from = null; });
    });
    map.querySelectorAll('button').forEach(function (button) {
      button.addEventListener('click', function () {
        var factor = Number(button.dataset.zoom);
        if (factor) { zoom(factor, box[0] + box[2] / 2, box[1] + box[3] / 2); }
        else { box = home.slice(); show(); }
      });
    });
    map.querySelectorAll('input').forEach(function (input) {
      input.addEventListener('change', function () {
        svg.getElementById(input.value).style.display = input.checked ? '' : 'none';
      });
    });
    document.querySelectorAll('tr.pick').forEach(function (row) {
      row.addEventListener('click', function () {
        var wide = 40, high = wide * home[3] / home[2];
        var turn = svg.getScreenCTM().inverse().multiply(world.getScreenCTM());
        var p = new DOMPoint(row.dataset.x, -row.dataset.y).matrixTransform(turn);
        box = [p.x - wide / 2, p.y - high / 2, wide, high];
        show();
        document.getElementById('map').scrollIntoView();
      });
    });
    window.addEventListener('resize', show);
    show();
  }
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
