// A scene is drawn twenty times a second, whether anything moves or not: here only if something did.
window.galenArm = (() => {
  function prepare(id) {
    const { renderer } = getElement(id);
    // Nothing of the page's look, dark or light, is to be painted over.
    renderer.setClearAlpha(0);
    const draw = renderer.render.bind(renderer);
    let drawn = "";
    renderer.render = (scene, camera) => {
      const canvas = renderer.domElement;
      if (canvas.offsetParent === null) return; // on a tab that isn't shown
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
    };
  }

  return { prepare };
})();
