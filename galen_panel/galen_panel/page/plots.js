// SPDX-License-Identifier: Apache-2.0
window.galenPlots = (() => {
  const looks = new Map(); // id -> [light, dark]
  const coloured = new WeakMap(); // chart -> whether dark

  const chartOf = (id) => getElement(id)?.chart;

  // Answers true when it has been drawn, so that a slow browser is not sent more than it can show.
  async function show(id, option) {
    const chart = chartOf(id);
    if (!chart) return false;
    chart.setOption(option);
    recolour(id);
    await galenPanel.drawn();
    return true;
  }

  function recolour(id) {
    const chart = chartOf(id);
    const dark = document.body.classList.contains("body--dark");
    if (!chart || !looks.has(id) || coloured.get(chart) === dark) return;
    coloured.set(chart, dark);
    chart.setOption(looks.get(id)[dark ? 1 : 0]);
  }

  function follow(id, lightAndDark) {
    looks.set(id, lightAndDark);
    recolour(id);
    new MutationObserver(() => recolour(id)).observe(document.body, { attributeFilter: ["class"] });
  }

  return { show, follow };
})();
