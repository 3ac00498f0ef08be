// Compiles every kernel text of a folder with Tint, the compiler of Dawn, and prints the texts that it
// refuses.
//
//     node check.mjs FOLDER
//
// Tint requires an extension for subgroup operations that wgpu's compiler does not know, so it is added here.
// It cannot prove that the threads of a subgroup take the same way through a loop over a ballot, so its rule
// for that is off. The rule for barriers and for `workgroupUniformLoad` is on. The null backend compiles
// without a card.
import { readdirSync, readFileSync } from 'node:fs';
import { join } from 'node:path';
import { create, globals } from 'webgpu';

Object.assign(globalThis, globals);
const SUBGROUPS = 'enable subgroups;\ndiagnostic(off, subgroup_uniformity);\n';

const folder = process.argv[2];
const gpu = create(['backend=null']);
const adapter = await gpu.requestAdapter();
if (!adapter?.features.has('subgroups')) {
    console.error('Dawn has no null backend with subgroups');
    process.exit(2);
}
const device = await adapter.requestDevice({ requiredFeatures: ['subgroups'] });
const files = readdirSync(folder).filter((name) => name.endsWith('.wgsl')).sort();
let refused = 0;
for (const name of files) {
    const text = readFileSync(join(folder, name), 'utf8');
    device.pushErrorScope('validation');
    const module = device.createShaderModule({ code: /\bsubgroup/.test(text) ? SUBGROUPS + text : text });
    const { messages } = await module.getCompilationInfo();
    await device.popErrorScope();
    const errors = messages.filter((message) => message.type === 'error');
    if (errors.length > 0) {
        refused += 1;
        console.log(`${name}: ${errors.map((error) => `line ${error.lineNum}: ${error.message}`).join('; ')}`);
    }
}
console.log(`accepted ${files.length - refused} of ${files.length}`);
process.exit(refused === 0 && files.length > 0 ? 0 : 1);
