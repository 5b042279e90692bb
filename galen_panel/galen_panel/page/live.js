// SPDX-License-Identifier: Apache-2.0
window.galenPanel = {
  // Resolves when what was changed has been drawn; at once where the browser draws nothing.
  drawn: () =>
    document.hidden
      ? Promise.resolve()
      : new Promise((resolve) => requestAnimationFrame(() => setTimeout(resolve))),
};
