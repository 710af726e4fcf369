// The part of the plane that a canvas shows: its middle in metres, and pixels for a metre.

const FINEST = 2000 // pixels for a metre
const COARSEST = 1e-3
const FARTHEST = 2e6 // m

export const START = { x: 0, y: 0, scale: 50 }

const within = (value, low, high) => Math.min(high, Math.max(low, value))

/** A viewport that can be drawn. */
function kept({ x, y, scale }) {
  return {
    x: within(x, -FARTHEST, FARTHEST), y: within(y, -FARTHEST, FARTHEST), scale: within(scale, COARSEST, FINEST),
  }
}

/** Moved by so many pixels to the right and down. */
export function panned(view, right, down) {
  return kept({ ...view, x: view.x - right / view.scale, y: view.y + down / view.scale })
}

/** Enlarged by a factor around a point, in pixels right of the canvas's middle and below it. */
export function zoomed(view, factor, right = 0, down = 0) {
  const scale = within(view.scale * factor, COARSEST, FINEST)
  const moved = 1 / view.scale - 1 / scale // m for each pixel
  return kept({ scale, x: view.x + right * moved, y: view.y - down * moved })
}

/** Around all of these points, x and y one after the other, in a canvas of that size. */
export function fitted(points, width, height) {
  let [left, right, low, high] = [Infinity, -Infinity, Infinity, -Infinity]
  for (let at = 0; at < points.length; at += 2) {
    left = Math.min(left, points[at])
    right = Math.max(right, points[at])
    low = Math.min(low, points[at + 1])
    high = Math.max(high, points[at + 1])
  }
  if (!(left <= right)) return START
  const scale = 0.92 * Math.min(width / Math.max(right - left, 1), height / Math.max(high - low, 1))
  return kept({ x: (left + right) / 2, y: (low + high) / 2, scale })
}
