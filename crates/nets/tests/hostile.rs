//! Damaged and hostile checkpoint files give an error, never a panic, a call or a large allocation.
//!
//! This is a test binary of its own, because it reads the peak memory of the process.

use use3d_numerics::random::{Purpose, Stream};

#[allow(dead_code, unused_imports, reason = "each test binary uses a part of it")]
mod torch_files;
use torch_files::{
    Nesting, Pickle, heads, legacy_file, legacy_with_pickle, read_all, safetensors_file, zip_file,
    zip_with_pickle,
};

#[test]
fn no_mutation_of_a_file_panics_or_takes_much_memory() {
    let tensors = heads();
    let dir = tempfile::tempdir().unwrap();
    let before = peak_memory();
    let files =
        [zip_file(&tensors, Nesting::Net), legacy_file(&tensors, Nesting::Root), safetensors_file(&tensors)];
    let mut outcomes = [0; 2];
    for (kind, original) in files.iter().enumerate() {
        let stream = Stream::new(5, Purpose::new("mutations"), kind as u64);
        // The payload is 4608 bytes of floats; most mutations should hit the structure around it.
        for round in 0..1200u64 {
            let mut bytes = original.clone();
            match round % 4 {
                0 => bytes.truncate(stream.below(round, bytes.len())),
                1 => {
                    let at = stream.below(3 * round, bytes.len());
                    bytes[at] ^= 1 << stream.below(3 * round + 1, 8);
                }
                2 => {
                    let at = stream.below(3 * round, bytes.len().min(1500));
                    bytes[at] = stream.bits(3 * round + 1) as u8;
                }
                _ => {
                    // A run of large numbers, like a hostile length.
                    let at = stream.below(3 * round, bytes.len().saturating_sub(8));
                    let fill = if round % 8 == 3 { 0xff } else { 0x7f };
                    bytes[at..at + 4].fill(fill);
                }
            }
            outcomes[usize::from(read_all(dir.path(), &bytes, &tensors).is_ok())] += 1;
        }
    }
    assert!(outcomes[0] > 500 && outcomes[1] > 100, "{outcomes:?}");
    let grown = peak_memory() - before;
    assert!(grown < 256 << 20, "peak memory grew by {grown} bytes");
}

/// The process's peak resident memory if the system reports it, else 0.
fn peak_memory() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|l| l.strip_prefix("VmHWM:"));
    line.and_then(|l| l.trim().trim_end_matches(" kB").parse::<u64>().ok()).map_or(0, |kb| kb << 10)
}

#[test]
fn hostile_pickles_end_in_an_error_and_execute_nothing() {
    let tensors = heads();
    let dir = tempfile::tempdir().unwrap();
    let marker = dir.path().join("executed");
    let mut hostile: Vec<(&str, Vec<u8>)> = Vec::new();

    let mut call = Pickle::start();
    call.class("os", "system")
        .op(b'(')
        .text(&format!("touch {}", marker.display()))
        .op(b't')
        .op(b'R')
        .op(b'.');
    hostile.push(("a call of os.system", call.0));

    let mut build = Pickle::start();
    build.class("builtins", "exec").op(b'(').text(&format!("open({marker:?}, 'w')")).op(b't').op(b'R');
    build.op(b'}').op(b'b').op(b'.');
    hostile.push(("exec with a state", build.0));

    let mut text = Pickle::start();
    text.op(b'X').0.extend(u32::MAX.to_le_bytes());
    hostile.push(("a string of 4 GiB", text.0));

    let mut text = Pickle::start();
    text.op(0x8d).0.extend((u64::MAX / 2).to_le_bytes());
    hostile.push(("a string of 2^63 bytes", text.0));

    let mut long = Pickle::start();
    long.op(0x8b).0.extend(i32::MAX.to_le_bytes());
    hostile.push(("an integer of 2 GiB", long.0));

    let mut deep = Pickle::start();
    (0..200_000).for_each(|_| {
        deep.op(b']');
    });
    (0..199_999).for_each(|_| {
        deep.op(b'a');
    });
    deep.op(b'.');
    hostile.push(("lists 200 000 deep", deep.0));

    // Every list contains the one before twice: 2^60 leaves in 400 bytes.
    let mut doubling = Pickle::start();
    doubling.op(b']').op(b'q').op(0);
    for level in 1..60u8 {
        doubling
            .op(b'0')
            .op(b']')
            .op(b'(')
            .op(b'h')
            .op(level - 1)
            .op(b'h')
            .op(level - 1)
            .op(b'e')
            .op(b'q')
            .op(level);
    }
    doubling.op(b'.');
    hostile.push(("doubling lists", doubling.0));

    let mut huge = Pickle::start();
    huge.op(b'}').op(b'(').text("lin0.model.1.weight");
    huge.class("torch._utils", "_rebuild_tensor_v2").op(b'(').op(b'(').text("storage");
    huge.class("torch", "FloatStorage").text("0").text("cpu").int(64).op(b't').op(b'Q').int(0);
    huge.op(b'(').int(1).int(i32::MAX as usize).int(1).int(1).op(b't');
    huge.op(b'(').int(0).int(0).int(0).int(0).op(b't').op(0x89);
    huge.class("collections", "OrderedDict").op(b')').op(b'R').op(b't').op(b'R').op(b'u').op(b'.');
    hostile.push(("a tensor expanded to 8 GiB", huge.0));

    let before = peak_memory();
    for (what, pickle) in &hostile {
        for bytes in [zip_with_pickle(pickle, &tensors), legacy_with_pickle(pickle, &tensors), pickle.clone()]
        {
            let result = read_all(dir.path(), &bytes, &tensors);
            let error = result.expect_err(what);
            println!("{what}: {error}");
        }
        assert!(!marker.exists(), "{what} was executed");
    }
    let grown = peak_memory() - before;
    assert!(grown < 512 << 20, "peak memory grew by {grown} bytes");
}
