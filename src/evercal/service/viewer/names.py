"""What viser's client leaves out for screen readers and weak eyes, added in the browser.

Sliders and their numbers have no name, buttons with an icon neither, and labels are grey on grey.
"""

import viser

_STYLE = ":root { --mantine-color-dimmed: #b0b0b0 !important }"
_SCRIPT = """
const icons = {'list-search': 'Commands', adjustments: 'Settings', minus: 'Collapse',
  plus: 'Expand', 'chevrons-right': 'Collapse', 'chevrons-left': 'Expand'};
const unnamed = e => !e.getAttribute('aria-label') && !e.getAttribute('aria-labelledby');
const name = () => {
  for (const e of document.querySelectorAll('[role=slider], input[inputmode=decimal]'))
    if (unnamed(e))
      for (let row = e.parentElement; row; row = row.parentElement) {
        const label = row.querySelector('label');
        if (label) { e.setAttribute('aria-label', label.textContent); break }
      }
  for (const e of document.querySelectorAll('button'))
    if (unnamed(e) && !e.textContent.trim()) {
      const icon = /tabler-icon-([a-z-]+)/.exec(e.querySelector('svg')?.getAttribute('class'));
      e.setAttribute('aria-label', icon ? icons[icon[1]] ?? icon[1] : 'Close');
    }
};
document.title = this.alt;
this.alt = '';
let waits = false;
const soon = () => {
  if (waits) return;
  waits = true;
  setTimeout(() => { waits = false; name() }, 200);
};
new MutationObserver(soon).observe(document.body, {childList: true, subtree: true});
name();
"""
_PIXEL = "data:image/gif;base64,R0lGODlhAQABAAAAACH5BAEKAAEALAAAAAABAAEAAAICTAEAOw=="


def add_names(server: viser.ViserServer, title: str) -> None:
    """Name the page and its controls; viser takes no scripts but those of an element's events."""
    script = _SCRIPT.replace("&", "&amp;").replace('"', "&quot;")
    picture = f'<img src="{_PIXEL}" alt="{title}" style="display:none" onload="{script}">'
    server.gui.add_html(f"<style>{_STYLE}</style>{picture}")
