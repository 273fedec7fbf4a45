"""The style sheet of a report: on a screen of any width, and printed."""

from typing import Final

STYLE: Final = """
:root{color-scheme:light}
body{font:15px/1.45 system-ui,sans-serif;max-width:62rem;margin:0 auto;padding:1rem;color:#111;
background:#fff}
h1{font-size:1.5rem;overflow-wrap:anywhere}h2{font-size:1.15rem;margin-top:2rem;
border-bottom:1px solid #ccc}
.scroll{overflow-x:auto}table{border-collapse:collapse;margin:.5rem 0;font-size:.9rem}
th,td{padding:.2rem .6rem;border-bottom:1px solid #ddd;text-align:right;vertical-align:top}
th:first-child,td:first-child{text-align:left}
td.w{text-align:left}table.words td{text-align:left;overflow-wrap:anywhere}
figure{margin:1rem 0;break-inside:avoid}
figure img{display:block;width:100%;min-width:40rem;max-width:58rem;height:auto}
figcaption{color:#444;font-size:.9rem}
.facts{display:grid;grid-template-columns:repeat(auto-fit,minmax(9.5rem,1fr));gap:.5rem;padding:0;
list-style:none}.facts li{border:1px solid #ccc;border-radius:.4rem;padding:.5rem}
.facts b{display:block;font-size:1.2rem}.warn{border-left:4px solid #D55E00;padding-left:.7rem}
@media print{body{max-width:none;font-size:10pt}figure img{min-width:0}.scroll{overflow:visible}
h2{break-after:avoid}tr{break-inside:avoid}}
"""
