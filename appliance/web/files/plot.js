// A plot of a number over time, with uPlot; loaded when somebody plots.

import uPlot from './vendor/uPlot.esm.js'

const style = document.createElement('link')
style.rel = 'stylesheet'
style.href = new URL('./vendor/uPlot.min.css', import.meta.url).href
document.head.append(style)

export function makePlot(element, label, points) {
  const colour = (name) => () => getComputedStyle(document.documentElement).getPropertyValue(name)
  const axis = { stroke: colour('--text'), grid: { stroke: colour('--line') }, ticks: { stroke: colour('--line') } }
  const size = () => ({ width: Math.max(200, element.clientWidth), height: 180 })
  const plot = new uPlot({
    ...size(),
    legend: { show: false },
    cursor: { drag: { x: false, y: false } },
    axes: [axis, { ...axis, size: 60 }],
    series: [{}, { label, stroke: colour('--accent'), width: 2, points: { show: points.length < 50 } }],
  }, columns(points), element)
  const watch = new ResizeObserver(() => plot.setSize(size()))
  watch.observe(element)
  return {
    show: (more) => plot.setData(columns(more)),
    destroy: () => {
      watch.disconnect()
      plot.destroy()
    },
  }
}

function columns(points) {
  return [points.map(([at]) => at), points.map(([, value]) => value)]
}
