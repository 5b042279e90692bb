// The rows that a chart shows are kept here, so that only new ones travel to the browser.
window.galenPlots = (() => {
  const kept = new WeakMap(); // chart -> rows of each stream, [time, value, ...], NaN ends a line

  const chartOf = (id) => getElement(id)?.chart;
  const isDark = () => document.body.classList.contains("body--dark");

  function firstFrom(rows, time) {
    let index = rows.length;
    while (index > 0 && rows[index - 1][0] >= time) index--;
    return index;
  }

  // message: {now, span, looks: [light, dark], option?, streams: [{whole, from, rows}]}, times in ms.
  // Answers true when it has been drawn, so that a slow browser is not sent more than it can show,
  // and false where it lacks what came before: then all of it has to be sent.
  async function patch(id, message) {
    const chart = chartOf(id);
    if (!chart) return false;
    let state = kept.get(chart);
    if (!state) {
      if (!message.streams.every((stream) => stream.whole)) return false;
      state = { streams: message.streams.map(() => []), dark: null };
      kept.set(chart, state);
    }
    message.streams.forEach((stream, index) => {
      const rows = state.streams[index];
      rows.length = stream.whole ? 0 : firstFrom(rows, stream.from);
      rows.push(...stream.rows);
      // One row more, so that the line reaches the edge.
      const old = firstFrom(rows, message.now - 1000 * message.span) - 1;
      if (old > 0) rows.splice(0, old);
    });
    state.looks = message.looks ?? state.looks;
    if (message.option) chart.setOption(message.option);
    recolour(chart, state);
    chart.setOption({
      dataset: state.streams.map((rows) => ({
        source: rows.map(([time, ...values]) => [(time - message.now) / 1000, ...values]),
      })),
    });
    await galenPanel.drawn();
    return true;
  }

  function recolour(chart, state) {
    const dark = isDark();
    if (state.dark === dark || !state.looks) return;
    state.dark = dark;
    chart.setOption(state.looks[dark ? 1 : 0]);
  }

  function follow(id) {
    new MutationObserver(() => {
      const chart = chartOf(id);
      if (kept.has(chart)) recolour(chart, kept.get(chart));
    }).observe(document.body, { attributeFilter: ["class"] });
  }

  return { patch, follow };
})();
