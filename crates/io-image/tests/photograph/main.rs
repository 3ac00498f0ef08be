//! Photographs are read with all of their metadata, and new pixels are written into files of the same kind.

mod broken;
mod exr;
mod fixtures;
mod jpeg;
mod png;
mod tiff;
mod tools;

use std::path::Path;

use fixtures::{HISTORY, SOFTWARE};
use use3d_io_image::{Photograph, Rgb};

/// Reads a photograph, inverts its pixels, writes it, and returns the written file.
fn inverted(bytes: &[u8], name: &str) -> (Photograph, Vec<u8>) {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join(name);
    std::fs::write(&path, bytes).unwrap();
    let photograph = Photograph::read(&path).unwrap();
    let mut new = photograph.clone();
    match &mut new.pixels {
        Rgb::Eight(s) => s.iter_mut().for_each(|v| *v = 255 - *v),
        Rgb::Sixteen(s) => s.iter_mut().for_each(|v| *v = 65535 - *v),
        Rgb::Float(s) => s.iter_mut().for_each(|v| *v = 1.0 - *v),
    }
    let out = dir.path().join("new").join(name);
    new.write(&out, SOFTWARE, HISTORY).unwrap();
    let again = Photograph::read(&out).unwrap();
    assert_eq!(again.orientation(), photograph.orientation());
    assert_eq!((again.width, again.height), (photograph.width, photograph.height));
    assert_eq!(again.alpha, photograph.alpha);
    assert!(again.notes.is_empty(), "{:?}", again.notes);
    if name.ends_with("jpg") {
        let (Rgb::Eight(a), Rgb::Eight(b)) = (&again.pixels, &new.pixels) else { panic!("8 bits expected") };
        let worst = a.iter().zip(b).map(|(a, b)| a.abs_diff(*b)).max();
        assert!(worst <= Some(16), "{worst:?}");
    } else {
        assert_eq!(again.pixels, new.pixels);
    }
    let written = std::fs::read(&out).unwrap();
    // The same input gives the same bytes.
    new.write(&out, SOFTWARE, HISTORY).unwrap();
    assert_eq!(written, std::fs::read(&out).unwrap());
    (photograph, written)
}

#[test]
fn errors_name_the_file_and_the_remedy() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.jpg");
    let said = Photograph::read(&path).unwrap_err().to_string();
    assert!(said.contains("a.jpg"), "{said}");
    let whole = fixtures::jpeg(false);
    std::fs::write(&path, &whole[..whole.len() - 200]).unwrap();
    let said = Photograph::read(&path).unwrap_err().to_string();
    assert!(said.contains("a.jpg") && said.contains("end marker"), "{said}");
    std::fs::write(&path, &whole).unwrap();
    let mut photograph = Photograph::read(&path).unwrap();
    let said = photograph.write(dir.path(), SOFTWARE, HISTORY).unwrap_err().to_string();
    assert!(said.contains("cannot be written"), "{said}");
    let folder_is_a_file = path.join("b.jpg");
    assert!(photograph.write(&folder_is_a_file, SOFTWARE, HISTORY).is_err());
    photograph.pixels = Rgb::Sixteen(vec![0; 48 * 32 * 3]);
    let out = dir.path().join("b.jpg");
    let said = photograph.write(&out, SOFTWARE, HISTORY).unwrap_err().to_string();
    assert!(said.contains("b.jpg") && said.contains("JPEG files hold no such samples"), "{said}");
    photograph.pixels = Rgb::Eight(vec![0; 48 * 32]);
    let said = photograph.write(&out, SOFTWARE, HISTORY).unwrap_err().to_string();
    assert!(said.contains("1536 samples instead of 3 for each of 48x32 pixels"), "{said}");
    photograph.pixels = Rgb::Eight(vec![0; 48 * 32 * 3]);
    photograph.alpha = Some(Rgb::Eight(vec![0; 48 * 32]));
    assert!(photograph.write(&out, SOFTWARE, HISTORY).is_err());
    assert!(!out.exists() && std::fs::read_dir(dir.path()).unwrap().count() == 1, "a file was left behind");
    let npy = b"\x93NUMPY\x01\x00\x46\x00{'descr': '<f4', 'fortran_order': False, 'shape': (1, 1), }";
    let said = Photograph::of_bytes(npy.to_vec(), Path::new("d.npy")).unwrap_err().to_string();
    assert!(said.contains("d.npy"), "{said}");
}
