//! PLY files: our own, other tools', and hostile ones.

use use3d_numerics::random::{Purpose, Stream};
use use3d_splat::{Gaussians, ply};

use crate::support::random_gaussians;

fn bytes_of(gaussians: &Gaussians) -> Vec<u8> {
    let mut bytes = Vec::new();
    ply::write(gaussians, &mut bytes).unwrap();
    bytes
}

#[test]
fn what_is_written_is_read_back_bit_for_bit() {
    let mut gaussians = random_gaussians(100, -2.0, 1);
    gaussians.means[3] = [f32::MIN_POSITIVE, -0.0, f32::MAX];
    assert_eq!(ply::read(&bytes_of(&gaussians)[..]).unwrap(), gaussians);
    assert!(ply::read(&bytes_of(&Gaussians::empty(3))[..]).unwrap().is_empty());
}

/// A file as another tool might write it: any format, degree, order, type, extra properties and elements.
fn foreign(gaussians: &Gaussians, degree: usize, format: &str) -> Vec<u8> {
    let big = format == "binary_big_endian";
    let bands = (degree + 1) * (degree + 1);
    let mut out = format!(
        "ply\r\nformat {format} 1.0\r\ncomment by another tool\r\nobj_info nothing\r\n\
         element camera 2\r\nproperty list uchar int indices\r\nproperty double focal\r\nelement vertex {}\r\n",
        gaussians.len()
    );
    let mut names: Vec<(String, bool)> = vec![("opacity".into(), true), ("red".into(), false)];
    names.extend(["rot_0", "rot_1", "rot_2", "rot_3", "x", "y", "z"].map(|n| (n.to_string(), true)));
    names.extend((0..3 * (bands - 1)).map(|i| (format!("f_rest_{i}"), true)));
    names.extend(
        ["f_dc_0", "f_dc_1", "f_dc_2", "scale_0", "scale_1", "scale_2"].map(|n| (n.to_string(), true)),
    );
    for (i, (name, float)) in names.iter().enumerate() {
        let kind = if !float {
            "uchar"
        } else if i % 2 == 0 {
            "float"
        } else {
            "double"
        };
        out += &format!("property {kind} {name}\r\n");
    }
    out += "property list uint8 float32 neighbours\r\nelement face 0\r\nproperty list uchar int vertex_indices\r\nend_header\r\n";
    let mut out = out.into_bytes();
    enum Value {
        Byte(u8),
        Int(i32),
        Float(f32),
        Double(f64),
    }
    let mut put = |value: Value| match (format, value) {
        ("ascii", Value::Byte(v)) => out.extend(format!("{v} ").bytes()),
        ("ascii", Value::Int(v)) => out.extend(format!("{v}\n").bytes()),
        ("ascii", Value::Float(v)) => out.extend(format!("{v:e}\t").bytes()),
        ("ascii", Value::Double(v)) => out.extend(format!("{v} ").bytes()),
        (_, Value::Byte(v)) => out.push(v),
        (_, Value::Int(v)) => out.extend(if big { v.to_be_bytes() } else { v.to_le_bytes() }),
        (_, Value::Float(v)) => out.extend(if big { v.to_be_bytes() } else { v.to_le_bytes() }),
        (_, Value::Double(v)) => out.extend(if big { v.to_be_bytes() } else { v.to_le_bytes() }),
    };
    for camera in 0..2 {
        put(Value::Byte(camera * 3));
        for i in 0..i32::from(camera) * 3 {
            put(Value::Int(i));
        }
        put(Value::Double(1.5));
    }
    for g in 0..gaussians.len() {
        for (i, (name, float)) in names.iter().enumerate() {
            let digit = |n: &str| n.rsplit('_').next().unwrap().parse::<usize>().unwrap();
            let value = match name.as_str() {
                "opacity" => gaussians.opacity_logits[g],
                "x" => gaussians.means[g][0],
                "y" => gaussians.means[g][1],
                "z" => gaussians.means[g][2],
                n if n.starts_with("rot") => gaussians.quaternions[g][digit(n)],
                n if n.starts_with("scale") => gaussians.log_scales[g][digit(n)],
                n if n.starts_with("f_dc") => gaussians.sh[g][0][digit(n)],
                n if n.starts_with("f_rest") => {
                    let i = digit(n);
                    gaussians.sh[g][1 + i % (bands - 1)][i / (bands - 1)]
                }
                _ => 0.0,
            };
            match (float, i % 2) {
                (false, _) => put(Value::Byte(200)),
                (true, 0) => put(Value::Float(value)),
                (true, _) => put(Value::Double(f64::from(value))),
            }
        }
        put(Value::Byte(1));
        put(Value::Float(2.5));
    }
    out
}

#[test]
fn files_of_other_tools_are_read() {
    for degree in 0..=3 {
        let mut gaussians = random_gaussians(20, -2.0, degree as u64);
        gaussians.sh_degree = degree;
        for sh in &mut gaussians.sh {
            sh[(degree + 1) * (degree + 1)..].fill([0.0; 3]);
        }
        for format in ["ascii", "binary_little_endian", "binary_big_endian"] {
            let read = ply::read(&foreign(&gaussians, degree, format)[..]).unwrap();
            assert_eq!(read, gaussians, "degree {degree}, {format}");
        }
    }
}

#[test]
fn golden_scene_folder_holds_the_truth() {
    let root = use3d_golden::root().join("scene-mini");
    let part = use3d_golden::Part::load(&root.join("truth.safetensors"));
    let truth = part.whole();
    let path = root.join("scene/gaussians.ply");
    let file = std::fs::File::open(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    let gaussians = ply::read(file).unwrap();
    assert_eq!(gaussians.means, truth.rows::<3>("means"));
    assert_eq!(gaussians.quaternions, truth.rows::<4>("quats"));
    assert_eq!(gaussians.opacity_logits, truth.f32("opacity_logits"));
    assert_eq!(gaussians.log_scales, truth.rows::<3>("log_scales"));
    assert_eq!(gaussians.sh.as_flattened().as_flattened(), truth.f32("sh"));
}

#[test]
fn errors_say_what_is_wrong() {
    let text = |s: &str| ply::read(s.as_bytes()).unwrap_err().to_string();
    assert!(text("").contains("not a PLY"));
    assert!(text("solid cube\n").contains("not a PLY"));
    assert!(
        text("ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nend_header\n")
            .contains("no property `y`")
    );
    assert!(text("ply\nformat ascii 1.0\nend_header\n").contains("no `vertex`"));
    assert!(text("ply\nformat ebcdic 1.0\nend_header\n").contains("line 2"));
    assert!(text("ply\nelement vertex -3\n").contains("not a whole number"));
    assert!(text("ply\nelement vertex 3\nproperty float128 x\n").contains("unknown type"));
    assert!(text(&format!("ply\ncomment {}\n", "x".repeat(10_000))).contains("too long"));
    let mut file = bytes_of(&random_gaussians(3, -2.0, 1));
    file.truncate(file.len() - 1);
    assert!(ply::read(&file[..]).unwrap_err().to_string().contains("ends at vertex 2 of 3"));
    let mut ascii = foreign(&random_gaussians(3, -2.0, 1), 3, "ascii");
    let n = ascii.len();
    ascii[n - 40..n - 30].fill(b'?');
    assert!(ply::read(&ascii[..]).unwrap_err().to_string().contains("is not a number"));
}

/// A header with a count of 2⁶⁰ costs neither memory nor time.
#[test]
fn counts_are_not_believed() {
    let honest = bytes_of(&random_gaussians(3, -2.0, 1));
    let text = String::from_utf8_lossy(&honest[..200]).into_owned();
    assert!(text.contains("element vertex 3\n"));
    let lying: Vec<u8> = [
        b"ply\nformat binary_little_endian 1.0\nelement vertex 1152921504606846976\n".to_vec(),
        honest[text.find("property").unwrap()..].to_vec(),
    ]
    .concat();
    assert!(
        ply::read(&lying[..]).unwrap_err().to_string().contains("ends at vertex 3 of 1152921504606846976")
    );
    let list = "ply\nformat binary_little_endian 1.0\nelement junk 1152921504606846976\nproperty list uint int v\nend_header\n";
    let mut list = list.as_bytes().to_vec();
    list.extend([0xff; 64]);
    assert!(ply::read(&list[..]).is_err());
    let empty = "ply\nformat ascii 1.0\nelement junk 1152921504606846976\nelement vertex 0\nend_header\n";
    assert!(ply::read(empty.as_bytes()).unwrap_err().to_string().contains("no property `x`"));
}

/// Bounded, seeded mutations: flipped, cut, doubled and spliced files give a value or an error, never a
/// panic.
#[test]
fn mutated_files_never_panic() {
    let s = Stream::new(7, Purpose::new("ply mutations"), 0);
    let gaussians = random_gaussians(4, -2.0, 1);
    let seeds: Vec<Vec<u8>> = ["ascii", "binary_little_endian", "binary_big_endian"]
        .iter()
        .map(|f| foreign(&gaussians, 1, f))
        .chain([bytes_of(&gaussians)])
        .collect();
    let words: [&[u8]; 10] = [
        b"element vertex 99999999999\n",
        b"property list uchar float x\n",
        b"property list double double y\n",
        b"end_header\n",
        b"format ascii 1.0\n",
        b"element face 18446744073709551615\n",
        b"-1",
        b"nan ",
        b"1e400 ",
        b"\0\xff\xff\xff\xff",
    ];
    let mut read = 0;
    for round in 0..6000u64 {
        let r = |k: u64, n: usize| s.below(round * 64 + k, n.max(1));
        let mut file = seeds[r(0, seeds.len())].clone();
        for step in 0..1 + r(1, 4) as u64 {
            let k = 2 + step * 8;
            let at = r(k, file.len());
            match r(k + 1, 6) {
                0 => file[at] ^= 1 << r(k + 2, 8),
                1 => file[at] = r(k + 2, 256) as u8,
                2 => file.truncate(at),
                3 => {
                    let word = words[r(k + 2, words.len())];
                    file.splice(at..at, word.iter().copied());
                }
                4 => {
                    let end = (at + r(k + 2, 60)).min(file.len());
                    file.drain(at..end);
                }
                _ => {
                    let end = (at + r(k + 2, 200)).min(file.len());
                    let copy = file[at..end].to_vec();
                    file.splice(at..at, copy);
                }
            }
            if file.is_empty() {
                break;
            }
        }
        if let Ok(gaussians) = ply::read(&file[..]) {
            assert_eq!(gaussians.sh.len(), gaussians.len());
            read += 1;
        }
    }
    assert!(
        read > 100,
        "only {read} of the mutated files could be read: the mutations are too wild to test much"
    );
}
