#!/usr/bin/env bash
# Package:  onnxruntime 1.30.0 (PyPI), onnxruntime-node 1.30.0 and onnxruntime-web 1.30.0 (npm), onnx 1.22.0
# Guess:    a graph input that has an initializer of its name is optional wherever ONNX Runtime runs: the value that is fed
#           replaces the default, and the default is used where none is fed (ONNX IR 4 and later).
# Seen:     each binding does something else with the value. Python uses it. Node.js ignores it without a word and answers
#           with the default; it ignores any name that is not a required input, misspelt ones too. The web build throws
#           "invalid input". Without the value all three use the default, and only Python lists the input
#           (get_overridable_initializers; C and C++ have the like).
# Hurts:    models with an optional input, such as a camera's intrinsics or a threshold, that are tested in Python and
#           deployed in Node.js: every answer is that of the default.
# Remedy:   export a required input and let each caller fill in the default, stored beside the model.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -q --disable-pip-version-check onnxruntime==1.30.0 onnx==1.22.0 numpy==2.4.6
cd "$work"
echo '{"private": true, "type": "module"}' > package.json
npm install --silent --ignore-scripts --no-audit --no-fund onnxruntime-node@1.30.0 onnxruntime-web@1.30.0
"$work/venv/bin/python" - <<'PYTHON'
import numpy as np
import onnx
import onnxruntime

# y = scale * x, and scale is 2 unless it is given.
model = onnx.parser.parse_model("""
    <ir_version: 10, opset_import: ["": 18]>
    scaled (float[1] x, float[1] scale = {2.0}) => (float[1] y) { y = Mul (x, scale) }
""")
onnx.checker.check_model(model, full_check=True)
onnx.save(model, "scaled.onnx")
options = onnxruntime.SessionOptions()
options.log_severity_level = 3
session = onnxruntime.InferenceSession("scaled.onnx", options, providers=["CPUExecutionProvider"])
one = np.ones(1, np.float32)
print("onnxruntime", onnxruntime.__version__)
print("  optional inputs:", [each.name for each in session.get_overridable_initializers()])
left_out, given = session.run(None, {"x": one})[0].item(), session.run(None, {"x": one, "scale": 5 * one})[0].item()
print(f"  Python: left out {left_out:g}, 5 given {given:g}")
assert (left_out, given) == (2, 5), "Python does something else"
PYTHON
cat > run.mjs <<'NODE'
import { readFileSync } from "node:fs";
import { createRequire } from "node:module";
import assert from "node:assert";

const [name, expected] = process.argv.slice(2);
const ort = name === "onnxruntime-node" ? createRequire(import.meta.url)(name) : await import(name);
const session = await ort.InferenceSession.create(readFileSync("scaled.onnx"), { logSeverityLevel: 3 });
const one = (value) => new ort.Tensor("float32", Float32Array.of(value), [1]);
const answer = (feeds) => session.run(feeds).then(({ y }) => String(y.data[0]), ({ message }) => message);
const [leftOut, given, misspelt] = [
  await answer({ x: one(1) }),
  await answer({ x: one(1), scale: one(5) }),
  await answer({ x: one(1), scael: one(5) }),
];
console.log(`  ${name}: inputs ${session.inputNames}; left out ${leftOut}, 5 given ${given}, misspelt ${misspelt}`);
assert.equal(leftOut, "2", "the default is another");
assert.equal(given, expected, "the value given is treated otherwise");
NODE
node run.mjs onnxruntime-node 2
node run.mjs onnxruntime-web "invalid input 'scale'"
echo "as described"
