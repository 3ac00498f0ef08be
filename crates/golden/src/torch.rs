//! Writers of checkpoint files for tests: PyTorch's zip archive and its older pickle stream, each only in
//! part, and safetensors.

use std::collections::BTreeMap;

/// Names to shapes and values.
pub type Tensors = BTreeMap<String, (Vec<usize>, Vec<f32>)>;

/// The place of the state dict in the file.
#[derive(Clone, Copy, Debug)]
pub enum Nesting {
    /// At the root.
    Root,
    /// Under `net`, with an optimiser beside it.
    Net,
    /// At the root, with `module.` before every name.
    Module,
}

/// Pickle opcodes, protocol 2.
#[derive(Default)]
pub struct Pickle(
    /// The bytes written so far.
    pub Vec<u8>,
);

impl Pickle {
    /// The start of a pickle of protocol 2.
    pub fn start() -> Self {
        Self(vec![0x80, 2])
    }

    /// An opcode or a byte of its argument.
    pub fn op(&mut self, op: u8) -> &mut Self {
        self.0.push(op);
        self
    }

    /// A string.
    pub fn text(&mut self, text: &str) -> &mut Self {
        self.op(b'X').0.extend((text.len() as u32).to_le_bytes());
        self.0.extend(text.as_bytes());
        self
    }

    /// A whole number of 32 bits.
    pub fn int(&mut self, value: usize) -> &mut Self {
        self.op(b'J').0.extend((value as i32).to_le_bytes());
        self
    }

    /// A class or function by its module and name.
    pub fn class(&mut self, module: &str, name: &str) -> &mut Self {
        self.op(b'c').0.extend(format!("{module}\n{name}\n").as_bytes());
        self
    }

    fn ints(&mut self, values: &[usize]) -> &mut Self {
        self.op(b'(');
        values.iter().for_each(|&v| {
            self.int(v);
        });
        self.op(b't')
    }

    fn tensor(&mut self, key: usize, shape: &[usize], legacy: bool) -> &mut Self {
        let count: usize = shape.iter().product();
        let strides: Vec<usize> = (0..shape.len()).map(|i| shape[i + 1..].iter().product()).collect();
        self.class("torch._utils", "_rebuild_tensor_v2").op(b'(').op(b'(');
        self.text("storage").class("torch", "FloatStorage").text(&key.to_string()).text("cuda:0").int(count);
        if legacy {
            self.op(b'N');
        }
        self.op(b't').op(b'Q').int(0).ints(shape).ints(&strides).op(0x89);
        self.class("collections", "OrderedDict").op(b')').op(b'R').op(b't').op(b'R')
    }

    /// A state dict whose storages are numbered in the order of the names.
    pub fn state(&mut self, tensors: &Tensors, prefix: &str, legacy: bool) -> &mut Self {
        self.class("collections", "OrderedDict").op(b')').op(b'R').op(b'(');
        for (key, (name, (shape, _))) in tensors.iter().enumerate() {
            self.text(&format!("{prefix}{name}")).tensor(key, shape, legacy);
        }
        self.op(b'u')
    }

    fn object(tensors: &Tensors, nesting: Nesting, legacy: bool) -> Vec<u8> {
        let mut p = Self::start();
        match nesting {
            Nesting::Root => p.state(tensors, "", legacy),
            Nesting::Module => p.state(tensors, "module.", legacy),
            Nesting::Net => {
                p.op(b'}').op(b'(').text("epoch").int(7).text("net").state(tensors, "", legacy);
                // Moments of an optimiser under integer keys; they use the first storage again.
                let shape = &tensors.values().next().expect("a tensor").0;
                p.text("optimizer").op(b'}').op(b'(').text("state").op(b'}').op(b'(').int(0);
                p.tensor(0, shape, legacy).op(b'u').op(b'u').op(b'u')
            }
        };
        p.op(b'.');
        p.0
    }
}

fn bytes(values: &[f32]) -> Vec<u8> {
    values.iter().flat_map(|v| v.to_le_bytes()).collect()
}

/// A file of PyTorch 1.6 and later.
pub fn zip_file(tensors: &Tensors, nesting: Nesting) -> Vec<u8> {
    zip_with_pickle(&Pickle::object(tensors, nesting, false), tensors)
}

/// A zip archive with any pickle.
pub fn zip_with_pickle(pickle: &[u8], tensors: &Tensors) -> Vec<u8> {
    let mut entries = vec![("archive/data.pkl".to_string(), pickle.to_vec())];
    for (key, (_, values)) in tensors.values().enumerate() {
        entries.push((format!("archive/data/{key}"), bytes(values)));
    }
    entries.push(("archive/version".into(), b"3\n".to_vec()));
    let (mut file, mut directory) = (Vec::new(), Vec::new());
    for (name, data) in &entries {
        let offset = file.len() as u32;
        let mut header = Vec::new();
        for half in [20u16, 0, 0, 0, 33] {
            header.extend(half.to_le_bytes());
        }
        for word in [crc32(data), data.len() as u32, data.len() as u32] {
            header.extend(word.to_le_bytes());
        }
        header.extend((name.len() as u16).to_le_bytes());
        header.extend([0, 0]);
        file.extend(b"PK\x03\x04");
        file.extend(&header);
        file.extend(name.as_bytes());
        file.extend(data);
        directory.extend(b"PK\x01\x02\x14\x00");
        directory.extend(&header);
        directory.extend([0; 10]);
        directory.extend(offset.to_le_bytes());
        directory.extend(name.as_bytes());
    }
    let start = file.len() as u32;
    file.extend(&directory);
    file.extend(b"PK\x05\x06\0\0\0\0");
    for _ in 0..2 {
        file.extend((entries.len() as u16).to_le_bytes());
    }
    file.extend((directory.len() as u32).to_le_bytes());
    file.extend(start.to_le_bytes());
    file.extend([0, 0]);
    file
}

fn crc32(data: &[u8]) -> u32 {
    let table: Vec<u32> = (0..256u32)
        .map(|i| (0..8).fold(i, |c, _| if c & 1 == 1 { c >> 1 ^ 0xedb8_8320 } else { c >> 1 }))
        .collect();
    !data.iter().fold(!0u32, |c, &b| table[((c ^ u32::from(b)) & 0xff) as usize] ^ c >> 8)
}

/// A file of PyTorch before 1.6.
pub fn legacy_file(tensors: &Tensors, nesting: Nesting) -> Vec<u8> {
    legacy_with_pickle(&Pickle::object(tensors, nesting, true), tensors)
}

/// The older stream with any object.
pub fn legacy_with_pickle(pickle: &[u8], tensors: &Tensors) -> Vec<u8> {
    let mut file = vec![0x80, 2, 0x8a, 10];
    file.extend([0x6c, 0xfc, 0x9c, 0x46, 0xf9, 0x20, 0x6a, 0xa8, 0x50, 0x19, b'.']);
    file.extend([0x80, 2, b'M', 0xe9, 0x03, b'.']);
    let mut info = Pickle::start();
    info.op(b'}').op(b'(').text("protocol_version").int(1001).text("little_endian").op(0x88);
    info.text("type_sizes").op(b'}').op(b'(').text("short").int(2).text("int").int(4).text("long").int(4);
    info.op(b'u').op(b'u').op(b'.');
    file.extend(info.0);
    file.extend(pickle);
    let mut keys = Pickle::start();
    keys.op(b']').op(b'(');
    (0..tensors.len()).for_each(|key| {
        keys.text(&key.to_string());
    });
    keys.op(b'e').op(b'.');
    file.extend(keys.0);
    for (_, values) in tensors.values() {
        file.extend((values.len() as i64).to_le_bytes());
        file.extend(bytes(values));
    }
    file
}

/// A safetensors file.
pub fn safetensors_file(tensors: &Tensors) -> Vec<u8> {
    let data: Vec<(&String, &Vec<usize>, Vec<u8>)> =
        tensors.iter().map(|(name, (shape, values))| (name, shape, bytes(values))).collect();
    let views = data.iter().map(|(name, shape, data)| {
        let view = safetensors::tensor::TensorView::new(safetensors::Dtype::F32, (*shape).clone(), data);
        (name.as_str(), view.expect("a view"))
    });
    safetensors::serialize(views, None).expect("serialised")
}

/// A calibrator in the layout of the paper's authors (`transition_calibrator.pth`): an archive with a schema
/// and the state dict.
pub fn released_calibrator(schema_version: usize, tensors: &Tensors) -> Vec<u8> {
    let mut p = Pickle::start();
    p.op(b'}').op(b'(').text("schema").text("3duse_transition_calibrator");
    p.text("schema_version").int(schema_version);
    p.text("model_config")
        .op(b'}')
        .op(b'(')
        .text("global_hidden")
        .int(128)
        .text("mode")
        .text("residual")
        .op(b'u');
    p.text("state_dict").state(tensors, "", false);
    p.text("metadata").op(b'}').op(b'(').text("pairs").int(800).op(b'u');
    p.op(b'u').op(b'.');
    zip_with_pickle(&p.0, tensors)
}

/// The tensors of such a calibrator: both heads with small reproducible weights (with these hidden widths),
/// medians 0 and ranges 1.
pub fn released_calibrator_tensors(hidden: [usize; 2]) -> Tensors {
    let mut out = Tensors::new();
    let mut add = |name: String, shape: Vec<usize>, value: &dyn Fn(usize) -> f32| {
        let n = shape.iter().product();
        out.insert(name, (shape, (0..n).map(value).collect()));
    };
    // Multiples of 7919 in a short cycle: neighbours differ, and sums are near zero.
    let small = |i: usize| ((i * 7919) % 101) as f32 / 5050.0 - 0.01;
    for (head, inputs, hidden, outputs) in [("global", 30, hidden[0], 12), ("local", 54, hidden[1], 6)] {
        for (position, (i, o)) in [(0, (inputs, hidden)), (2, (hidden, hidden)), (4, (hidden, outputs))] {
            add(format!("{head}_head.{position}.weight"), vec![o, i], &small);
            add(format!("{head}_head.{position}.bias"), vec![o], &small);
        }
        for (part, n) in [("", outputs), ("_condition", inputs)] {
            add(format!("{head}{part}_median"), vec![n], &|_| 0.0);
            add(format!("{head}{part}_scale"), vec![n], &|_| 1.0);
        }
    }
    add("support_logit".into(), vec![3], &small);
    out
}
