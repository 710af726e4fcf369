// Hand the user a file.

const KEPT = 10000 // ms for the browser to take it

export function save(blob, name) {
  const link = document.createElement('a')
  link.href = URL.createObjectURL(blob)
  link.download = name.replace(/[^\w.-]+/g, '_').slice(-80)
  link.click()
  setTimeout(() => URL.revokeObjectURL(link.href), KEPT)
}
