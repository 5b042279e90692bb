"""What the plots in a page show, read out of ECharts itself."""

import numpy as np

# As the streams are sent to the page.
RAW, COMPENSATED, DEFLECTION = range(3)

_ROWS = """
const [testid, stream, seconds] = arguments;
const shown = document.querySelector(`[data-testid=${testid}]`);
const chart = shown && getElement(shown.id.slice(1))?.chart;
const source = chart?.getOption().dataset?.[stream]?.source ?? [];
return source.filter(row => row[0] >= -seconds && row.slice(1).every(Number.isFinite));
"""


def rows(browser, stream, seconds=2.0):
    """Rows (n, 1 + width) of the newest seconds: time before now, s, then N and mN·m, or mm."""
    found = browser.script(_ROWS, "plot", stream, seconds)
    return np.array(found) if found else np.zeros((0, 7))


def force_rms(browser, stream, seconds=1.0):
    """RMS of the plotted force's size over the newest seconds, N; None with nothing plotted."""
    found = rows(browser, stream, seconds)
    if len(found) < 3:
        return None
    return float(np.sqrt(np.mean(np.sum(found[:, 1:4] ** 2, axis=1))))
