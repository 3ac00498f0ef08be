use serde::{Deserialize, Serialize};

use super::*;

#[derive(Debug, PartialEq, Serialize, Deserialize)]
struct Document {
    format: String,
    version: u64,
    note: String,
}

fn document() -> Document {
    Document { format: "example".into(), version: 2, note: "a".into() }
}

fn example() -> Vec<u8> {
    let mut writer = TensorWriter::new();
    writer.f32("singles", &[2, 2], &[1.0, -2.0, 0.5, 1e-30]);
    writer.f64("doubles", &[3], &[0.1, 2.0, f64::MIN_POSITIVE]);
    writer.u32("counts", &[2], &[7, u32::MAX]);
    writer.finish_with(&document()).unwrap()
}

#[test]
fn a_file_gives_back_what_was_written() {
    let bytes = example();
    assert_eq!(bytes, example());
    let file = TensorFile::read(&bytes).unwrap();
    assert_eq!(file.names(), ["counts", "doubles", "singles"]);
    assert_eq!(file.document::<Document>("example", 2).unwrap(), document());
    assert_eq!(file.f32("singles", &[2, 2]).unwrap(), [1.0, -2.0, 0.5, 1e-30]);
    assert_eq!(file.f64("doubles", &[3]).unwrap(), [0.1, 2.0, f64::MIN_POSITIVE]);
    assert_eq!(file.u32("counts", &[2]).unwrap(), [7, u32::MAX]);
    assert_eq!(file.sides::<2>("singles", "[rows, columns]").unwrap(), [2, 2]);
    assert_eq!(file.narrowed("doubles").unwrap(), (vec![3], vec![0.1, 2.0, 0.0]));
    assert!(TensorFile::has_document(&bytes));
    assert!(!TensorFile::has_document(&TensorWriter::new().finish().unwrap()));
}

#[test]
fn what_is_wrong_is_named() {
    let bytes = example();
    let file = TensorFile::read(&bytes).unwrap();
    let said = |result: Result<Vec<f32>, TensorError>| result.unwrap_err().to_string();
    assert_eq!(said(file.f32("none", &[1])), "tensor `none` is missing");
    assert_eq!(said(file.f32("doubles", &[3])), "tensor `doubles` holds F64; expected F32");
    assert_eq!(said(file.f32("singles", &[4])), "tensor `singles` has shape [2, 2]; expected [4]");
    let sides = file.sides::<1>("singles", "[rows]").unwrap_err().to_string();
    assert_eq!(sides, "tensor `singles` has shape [2, 2]; expected [rows]");
    assert!(file.only(|name| name != "counts").unwrap_err().to_string().contains("`counts`"));
    assert!(file.only(|_| true).is_ok());
    let document = |format, version| file.document::<Document>(format, version).unwrap_err().to_string();
    assert!(document("another", 2).contains("its format is \"example\", expected \"another\""));
    assert!(document("example", 3).contains("its version is 2, this tool reads version 3"));
    let mut writer = TensorWriter::new();
    writer.f32("singles", &[2], &[0.0, f32::NAN]);
    let bytes = writer.finish().unwrap();
    let bad = TensorFile::read(&bytes).unwrap();
    let message = bad.f32("singles", &[2]).unwrap_err().to_string();
    assert_eq!(message, "tensor `singles` is NaN at flat index 1; expected finite numbers");
    let message = bad.document::<Document>("example", 2).unwrap_err().to_string();
    assert!(message.contains("not written by this tool"), "{message}");
    writer.f32("short", &[3], &[0.0]);
    assert!(writer.finish().is_err(), "values that do not fill the shape");
}

#[test]
fn every_prefix_of_a_file_is_an_error_and_none_a_panic() {
    let bytes = example();
    for end in 0..bytes.len() {
        assert!(TensorFile::read(&bytes[..end]).is_err(), "prefix of {end} bytes");
    }
}
