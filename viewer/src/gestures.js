// Mouse, pen and fingers on a flat map: moving, zooming, pointing, choosing.

const CLICK_PX = 6;

/** Calls move(dx, dy), zoom(factor, x, y), point(x, y or null) and choose(x, y) for gestures on an element; wheel(event) returns whether it zooms. */
export function gestures(element, { move, zoom, point, choose, wheel = () => true }) {
  const down = new Map();
  let travelled = 0;
  const at = (event) => {
    const box = element.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  };

  element.addEventListener("pointerdown", (event) => {
    if (event.button) return;
    element.setPointerCapture(event.pointerId);
    if (!down.size) travelled = 0;
    down.set(event.pointerId, at(event));
  });
  element.addEventListener("pointermove", (event) => {
    const [x, y] = at(event);
    const before = down.get(event.pointerId);
    if (!before) {
      point(x, y);
      return;
    }
    const others = [...down].filter(([id]) => id !== event.pointerId).map(([, place]) => place);
    if (others.length) {
      const [other] = others;
      const apart = (place) => Math.hypot(place[0] - other[0], place[1] - other[1]) || 1;
      zoom(apart([x, y]) / apart(before), other[0], other[1]);
      travelled = Infinity;
    } else {
      travelled += Math.hypot(x - before[0], y - before[1]);
      if (travelled > CLICK_PX) move(x - before[0], y - before[1]);
    }
    down.set(event.pointerId, [x, y]);
  });
  const up = (event) => {
    const was = down.delete(event.pointerId);
    if (was && event.type === "pointerup" && !down.size && travelled <= CLICK_PX) choose(...at(event));
  };
  element.addEventListener("pointerup", up);
  element.addEventListener("pointercancel", up);
  element.addEventListener("pointerleave", () => point(null, null));
  element.addEventListener(
    "wheel",
    (event) => {
      if (!wheel(event)) return;
      event.preventDefault();
      zoom(2 ** (-event.deltaY / (event.deltaMode ? 12 : 400)), ...at(event));
    },
    { passive: false },
  );
}
