// A scene is drawn twenty times a second, whether anything moves or not: here only if something did.
window.galenArm = (() => {
  const REST = 4; // times as long as drawing takes

  function prepare(id) {
    const { renderer } = getElement(id);
    // Nothing of the page's look, dark or light, is to be painted over.
    renderer.setClearAlpha(0);
    const draw = renderer.render.bind(renderer);
    const gl = renderer.getContext();
    const pixel = new Uint8Array(4);
    let drawn = "";
    let resume = 0;
    renderer.render = (scene, camera) => {
      const canvas = renderer.domElement;
      const begun = performance.now();
      if (canvas.offsetParent === null || begun < resume) return; // not shown, or too soon
      camera.updateMatrixWorld();
      const now = JSON.stringify([
        camera.matrixWorld.elements,
        camera.projectionMatrix.elements,
        canvas.width,
        canvas.height,
        scene.children.map((child) => child.userData.placed ?? 0),
      ]);
      if (now === drawn) return;
      drawn = now;
      draw(scene, camera);
      // Reading waits for the drawing. Where software does it, all else needs the time as well.
      gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel);
      const ended = performance.now();
      resume = ended + REST * (ended - begun);
    };
  }

  return { prepare };
})();
