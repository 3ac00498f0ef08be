//! Tests that the command calls no elementary function of the C library, whose last bits differ from one
//! library to the next: its list of imported symbols names none. Third-party code counts too, because it is
//! part of the same program.

use std::path::Path;

/// Functions of `<math.h>` that IEEE 754 does not fix to the last bit, without the suffixes `f` and `l`.
const OPEN: &[&str] = &[
    "acos", "acosh", "asin", "asinh", "atan", "atan2", "atanh", "cbrt", "cos", "cosh", "erf", "erfc", "exp",
    "exp10", "exp2", "expm1", "hypot", "j0", "j1", "jn", "lgamma", "lgamma_r", "log", "log10", "log1p",
    "log2", "pow", "pow10", "powi", "sin", "sincos", "sinh", "tan", "tanh", "tgamma", "y0", "y1", "yn",
];

fn number(bytes: &[u8], at: usize, width: usize) -> Option<usize> {
    let field = bytes.get(at..at.checked_add(width)?)?;
    Some(field.iter().rev().fold(0, |n, &b| n << 8 | usize::from(b)))
}

/// The undefined names in the dynamic symbol tables of a 64-bit little-endian ELF file; `None` for any other
/// file.
fn imports(elf: &[u8]) -> Option<Vec<String>> {
    const DYNAMIC_SYMBOLS: usize = 11;
    if !elf.starts_with(b"\x7fELF\x02\x01") {
        return None;
    }
    let (table, size, count) = (number(elf, 0x28, 8)?, number(elf, 0x3a, 2)?, number(elf, 0x3c, 2)?);
    let section = |index: usize, field: usize, width: usize| number(elf, table + index * size + field, width);
    let mut names = Vec::new();
    for index in 0..count {
        if section(index, 0x04, 4)? != DYNAMIC_SYMBOLS {
            continue;
        }
        let strings = section(section(index, 0x28, 4)?, 0x18, 8)?;
        let (start, length) = (section(index, 0x18, 8)?, section(index, 0x20, 8)?);
        for symbol in (start..start + length).step_by(24) {
            if number(elf, symbol + 6, 2)? == 0 {
                let name = elf.get(strings + number(elf, symbol, 4)?..)?.split(|&b| b == 0).next()?;
                names.push(String::from_utf8_lossy(name).into_owned());
            }
        }
    }
    Some(names)
}

fn is_open(name: &str) -> bool {
    OPEN.iter().any(|open| name.strip_prefix(open).is_some_and(|rest| ["", "f", "l"].contains(&rest)))
}

/// With engines for graphics cards, the program contains a compiler of their kernels, which can evaluate
/// constants with the C library (and finds none to evaluate: the kernels' arithmetic is part of the numeric
/// class). So the rest is tested in a program without these engines.
#[test]
fn no_elementary_function_is_imported() {
    if cfg!(feature = "gpu") {
        eprintln!(
            "skipped: has engines for graphics cards; `cargo test -p use3d --no-default-features --test c_library`"
        );
        return;
    }
    let program = Path::new(env!("CARGO_BIN_EXE_use3d"));
    let Some(names) = imports(&std::fs::read(program).unwrap()) else {
        eprintln!("skipped: {} is no 64-bit ELF file, its imports cannot be read here", program.display());
        return;
    };
    let open: Vec<_> = names.iter().filter(|n| is_open(n)).collect();
    assert!(open.is_empty(), "taken from the C library: {open:?}; see docs/science/determinism.md");
}

#[test]
fn the_reader_finds_imports() {
    // This test's own program imports at least memory functions, unless it is linked statically.
    let own = imports(&std::fs::read(std::env::current_exe().unwrap()).unwrap());
    if cfg!(all(target_os = "linux", target_env = "gnu", target_pointer_width = "64")) {
        let own = own.expect("an ELF file");
        assert!(own.iter().any(|n| n == "malloc" || n == "memcpy"), "{own:?}");
    }
    assert!(
        is_open("expm1f")
            && is_open("pow")
            && !is_open("floor")
            && !is_open("fma")
            && !is_open("explicit_bzero")
    );
}
