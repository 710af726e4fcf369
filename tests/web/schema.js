// node schema.js URL-of-the-console's-files: exact numbers, hostile texts and hostile schemas.

import assert from 'node:assert/strict'

const { parse, print } = await import(`${process.argv[2]}/exact.js`)
const { check, constantsOf, describe, initial, schemaOf } = await import(`${process.argv[2]}/schema.js`)

// What is read is written again, digit by digit; no key is special.
for (const text of ['9007199254740993', '-0', '1.10', '1e400', '"\\u0000é\\n"', '[]', '{}', 'null', '[1, 2]', '18446744073709551615']) {
  assert.equal(print(parse(text)), text === '"\\u0000é\\n"' ? '"\\u0000é\\n"' : text)
}
const hostile = parse('{"__proto__": {"hacked": 1}, "constructor": 2, "a": 1, "a": 3}')
assert.deepEqual([...hostile.keys()], ['__proto__', 'constructor', 'a'])
assert.equal(hostile.get('a').text, '3')
assert.equal({}.hacked, undefined)
assert.equal(print(parse(print(hostile))), print(hostile))
assert.equal(print(parse('{"p": [{"x": 1}, []]}')), '{\n  "p": [\n    {\n      "x": 1\n    },\n    []\n  ]\n}')

// Texts that are no JSON are refused with the place; deep and long ones at once.
for (const [text, words] of [['', /ends too early/], ['{"a": 1,}', /line 1, column 9: the name/], ['[1\n 2]', /line 2, column 2/],
  ['{"a" 1}', /colon/], ['"a', /does not end/], ['"\\x"', /escape/], ['"\n"', /line break/], ['1 2', /follows/], ['01', /follows/],
  ['NaN', /a value/], ['Infinity', /a value/], ['truely', /follows/], ['{a: 1}', /double quotes/], ['['.repeat(1e6), /deeper than 64/],
  [`[${'1,'.repeat(1e6)}1]`, /more than 20000/], ['[', /early/]]) {
  assert.throws(() => parse(text), { name: 'SyntaxError', message: words }, text.slice(0, 20))
}

// A schema as the bridge makes it.
const root = schemaOf(JSON.stringify({
  title: 'a/msg/B', type: 'object', additionalProperties: false,
  properties: {
    big: 'BIG', small: { type: 'integer', minimum: 0, maximum: 255, default: 7 }, x: { type: ['number', 'null'] },
    text: { type: 'string', maxLength: 3 }, yes: { type: 'boolean' },
    bytes: { anyOf: [{ type: 'string', contentEncoding: 'base64' }, { type: 'array', items: { type: 'integer' }, maxItems: 4 }] },
    list: { type: 'array', items: { $ref: '#/$defs/a~1msg~1P' }, maxItems: 2 },
    fixed: { type: 'array', items: { type: ['number', 'null'] }, minItems: 3, maxItems: 3 },
    stamp: { anyOf: [{ $ref: '#/$defs/time' }, { const: 'now' }] }, mode: { enum: ['a', 'b'] },
    level: { oneOf: [{ const: 1 }, { const: 2 }] },
  },
  $defs: {
    'a/msg/P': { type: 'object', properties: { x: { type: ['number', 'null'] } } },
    time: { type: 'object', properties: { sec: { type: 'integer' } } },
  },
}).replace('"BIG"', '{"type": "integer", "minimum": -9223372036854775808, "maximum": 9223372036854775807}'))
const wrong = (text) => check(root, parse(text)).map(([path, words]) => `${path}: ${words}`)
assert.deepEqual(wrong('{"big": 9007199254740993, "small": 1, "x": null, "yes": true, "bytes": "AQI=", "list": [{"x": 1e3}], "stamp": "now", "mode": "b", "level": 2}'), [])
assert.deepEqual(wrong('{"big": 9223372036854775807, "fixed": [1, 2, 3], "bytes": [1, 2], "stamp": {"sec": 1}}'), [])
assert.deepEqual(wrong('{"big": 9223372036854775808}'), ['big: 9223372036854775808 is not within -9223372036854775808 to 9223372036854775807'])
for (const [text, path, words] of [
  ['{"small": 256}', 'small', /within 0 to 255/], ['{"small": 1.0}', 'small', /an integer/], ['{"small": 1e2}', 'small', /an integer/],
  ['{"big": 1e999}', 'big', /an integer/], [`{"big": ${'9'.repeat(100000)}}`, 'big', /within/], ['{"x": "NaN"}', 'x', /a number/],
  ['{"x": 1e999}', 'x', /infinity/], ['{"text": "four"}', 'text', /4 characters/], ['{"yes": 1}', 'yes', /true or false/],
  ['{"bytes": "%"}', 'bytes', /base64/], ['{"bytes": "AQIDBAU="}', 'bytes', /at most 4/], ['{"bytes": [256]}', 'bytes[0]', /255/],
  ['{"bytes": [null]}', 'bytes[0]', /255/], ['{"list": [{"y": 1}]}', 'list[0].y', /unknown/], ['{"list": [1]}', 'list[0]', /an object/],
  ['{"list": [{}, {}, {}]}', 'list', /at most 2/], ['{"fixed": [1]}', 'fixed', /exactly 3/], ['{"stamp": "then"}', 'stamp', /an object/],
  ['{"mode": "c"}', 'mode', /one of "a", "b"/], ['{"level": 3}', 'level', /one of 1, 2/], ['{"__proto__": 1}', '__proto__', /unknown/], ['[]', '', /an object/],
]) {
  const found = check(root, parse(text))
  assert.equal(found.length, 1, text)
  assert.equal(found[0][0], path, text)
  assert.match(found[0][1], words)
}
const field = (name) => describe(root, root.get('properties').get(name))
assert.equal(field('small').preset.text, '7')
assert.equal(field('stamp').kind, 'object')
assert.ok(field('stamp').isTime)
assert.equal(print(initial(root, root.get('properties').get('fixed'))), '[0, 0, 0]')

const named = schemaOf('{"type": "object", "properties": {"mode": {"type": "integer"}}, "x-constants": {"MODE_ON": 1, "MODELESS": 2, "MODE_BAD": {}, "X": 9007199254740993}}')
assert.deepEqual(constantsOf(describe(named, named), 'mode'), [['MODE_ON', '1']])
const badly = schemaOf('{"type": "object", "properties": {}, "x-constants": 5}')
assert.deepEqual(constantsOf(describe(badly, badly), 'mode'), [])

// Schemas that are none: no exception, no endless loop, nothing large.
assert.equal(schemaOf('{'), null)
assert.equal(schemaOf('5'), null)
const begun = performance.now()
const cyclic = schemaOf('{"$ref": "#/$defs/a", "$defs": {"a": {"$ref": "#/$defs/b"}, "b": {"$ref": "#/$defs/a"}}}')
assert.equal(describe(cyclic, cyclic).kind, 'any')
const recursive = schemaOf('{"type": "object", "properties": {"inner": {"$ref": "#"}, "list": {"type": "array", "minItems": 1000000000, "items": {"$ref": "#/properties/list"}}}}')
assert.equal(describe(recursive, recursive.get('properties').get('inner')).kind, 'object')
assert.ok(print(initial(recursive, recursive.get('properties').get('list'))).length < 10000)
assert.deepEqual(check(recursive, parse('{"inner": {"inner": {"inner": {}}}}')), [])
for (const text of ['{"type": 5, "properties": 6}', '{"type": "object", "properties": []}', '{"anyOf": [5, null]}', '{"enum": []}', '{"enum": {}}',
  '{"type": "array"}', '{"type": "array", "items": 5, "minItems": -1, "maxItems": "x"}', '{"$ref": "#/__proto__/constructor"}', '{"$ref": 5}',
  '{"type": "integer", "minimum": "a", "maximum": {}}', '{"type": {"__proto__": 1}}', '{"anyOf": [{"contentEncoding": "base64"}]}']) {
  const each = schemaOf(text)
  describe(each, each)
  initial(each, each)
  for (const value of ['{}', '[1]', '5', '"a"', 'null', 'true']) check(each, parse(value))
}
const many = schemaOf(JSON.stringify({ type: 'object', properties: Object.fromEntries(Array.from({ length: 5000 }, (_, n) => [`f${n}`, { type: 'boolean' }])) }))
assert.equal(check(many, parse(JSON.stringify(Object.fromEntries(Array.from({ length: 5000 }, (_, n) => [`f${n}`, 1]))))).length, 100)
assert.ok(performance.now() - begun < 20000)
console.log('ok')
