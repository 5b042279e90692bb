# SPDX-License-Identifier: Apache-2.0
"""What can be read on a page: each text that is seen, its size and contrast; what plots hold."""

import numpy as np

# Contrast as in WCAG 2.2; a background is what is painted below, one layer over the other. What is
# disabled is left out, as there; icons are not texts.
_TEXTS = """
const clear = [0, 0, 0, 0];
const canvas = document.createElement('canvas').getContext('2d', {willReadFrequently: true});
const parsed = new Map();
const parse = text => {
  if (!parsed.has(text)) {
    canvas.clearRect(0, 0, 1, 1);
    canvas.fillStyle = text;
    canvas.fillRect(0, 0, 1, 1);
    const [r, g, b, a] = canvas.getImageData(0, 0, 1, 1).data;
    parsed.set(text, a ? [r, g, b, a / 255] : clear);
  }
  return parsed.get(text);
};
const over = (top, below) => below.map((c, k) => k == 3 ? 1 : top[k] * top[3] + c * (1 - top[3]));
const luminance = color => {
  const [r, g, b] = color.slice(0, 3).map(c => c / 255)
    .map(c => c <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4);
  return 0.2126 * r + 0.7152 * g + 0.0722 * b;
};
const background = element => {
  const layers = [];
  for (let at = element; at; at = at.parentElement) {
    layers.push(parse(getComputedStyle(at).backgroundColor));
    if (layers.at(-1)[3] == 1) break;
  }
  return layers.reverse().reduce((below, top) => over(top, below), [255, 255, 255, 1]);
};
const found = [];
const walk = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
while (walk.nextNode()) {
  const text = walk.currentNode.textContent.trim();
  const element = walk.currentNode.parentElement;
  if (!text || ['SCRIPT', 'STYLE', 'TITLE'].includes(element.tagName)) continue;
  if (element.closest('.q-icon, [aria-hidden=true], .disabled, [aria-disabled=true], canvas'))
    continue;
  if (!element.checkVisibility({opacityProperty: true, visibilityProperty: true})) continue;
  const box = element.getBoundingClientRect();
  if (box.width < 2 || box.height < 2) continue;
  const style = getComputedStyle(element);
  const below = background(element);
  const [a, b] = [luminance(over(parse(style.color), below)), luminance(below)];
  // A label that is drawn smaller by a transformation is smaller; else they differ by rounding.
  const ratio = element.offsetHeight ? box.height / element.offsetHeight : 1;
  const scale = ratio < 0.95 ? ratio : 1;
  found.push({text: text.slice(0, 60), size: parseFloat(style.fontSize) * scale,
    contrast: (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05), of: element.className.toString()});
}
return found;
"""

# A text may be wider than its element, and a clipped one is longer.
_COLLISIONS = """
const found = [...document.querySelectorAll(arguments[0])].filter(one => one.checkVisibility()
  && !one.closest('.q-icon')
  && [...one.childNodes].some(node => node.nodeType == 3 && node.textContent.trim()));
const boxes = found.map(one => {
  const range = document.createRange();
  range.selectNodeContents(one);
  const [text, box] = [range.getBoundingClientRect(), one.getBoundingClientRect()];
  return {name: one.textContent, left: text.left, right: text.right,
    top: box.top, bottom: box.bottom};
});
const wrong = boxes.filter(a => a.left < -1 || a.right > innerWidth + 1).map(a => a.name);
boxes.forEach((a, index) => boxes.slice(index + 1).forEach(b => {
  if (Math.min(a.right, b.right) - Math.max(a.left, b.left) > 1
      && Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top) > 4)
    wrong.push(`${a.name} | ${b.name}`);
}));
return wrong;
"""

_FONTS_OF_PLOT = """
const shown = document.querySelector('[data-testid=plot]');
const sizes = [];
const look = (value, place) => {
  if (value && typeof value == 'object' && value.show !== false)
    for (const [name, inner] of Object.entries(value))
      // There are no selectors in the legend.
      if (name == 'fontSize') sizes.push([place, inner]);
      else if (name != 'selectorLabel') look(inner, `${place}.${name}`);
};
const option = getElement(shown.id.slice(1)).chart.getOption();
for (const name of ['textStyle', 'legend', 'xAxis', 'yAxis', 'title'])
  look([option[name]].flat(), name);
return sizes;
"""


# Streams as they are sent to the page.
RAW, COMPENSATED = 0, 1
_ROWS = """
const [stream, seconds] = arguments;
const shown = document.querySelector('[data-testid=plot]');
const chart = shown && getElement(shown.id.slice(1))?.chart;
const source = chart?.getOption().dataset?.[stream]?.source ?? [];
return source.filter(row => row[0] >= -seconds && row.slice(1).every(Number.isFinite));
"""


def rows(browser, stream, seconds=2.0):
    """Plotted rows (n, 1 + width) of the newest seconds: time, s, then N and mN·m, or mm."""
    found = browser.script(_ROWS, stream, seconds)
    return np.array(found) if found else np.zeros((0, 7))


def force_rms(browser, stream):
    """RMS of the plotted force's size over the newest second, N; None with nothing plotted."""
    found = rows(browser, stream, 1.0)
    return float(np.sqrt(np.mean(np.sum(found[:, 1:4] ** 2, axis=1)))) if len(found) > 2 else None


def texts(browser):
    """Each text that is seen: {text, size in px, contrast, of: its element's classes}."""
    return browser.script(_TEXTS)


def too_small(found, least_px=18.0):
    return [one for one in found if one["size"] < least_px - 0.01]


def too_faint(found, least=4.5):
    return [one for one in found if one["contrast"] < least]


def collisions(browser, selector):
    """Among the elements' texts: each that sticks out of the window, each pair that overlaps."""
    return browser.script(_COLLISIONS, selector)


def font_sizes_of_plot(browser):
    """Of what the chart writes itself: pairs (place in its options, font size in px)."""
    return browser.script(_FONTS_OF_PLOT)
