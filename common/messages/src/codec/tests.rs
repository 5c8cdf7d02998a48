#![allow(clippy::unwrap_used, clippy::expect_used)]

use super::*;
use crate::{Fault, Nothing, wire};
use serde::{Deserialize, Serialize};

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct Reading {
    position_m: [f64; 3],
    #[serde(with = "bytes_or_base64")]
    pixels: Vec<u8>,
    note: Option<f64>,
    pair: (u16, i32),
}
wire! { Reading = "reading/2" }

fn reading() -> Reading {
    Reading {
        position_m: [1.0, -0.5, 0.1],
        pixels: vec![0, 1, 254, 255],
        note: Some(2.5),
        pair: (7, -1),
    }
}

#[derive(Debug, Serialize, Deserialize)]
struct Checked {
    count: u32,
}
impl Wire for Checked {
    const SCHEMA: &'static str = "checked/1";
    fn validate(&self) -> Result<(), String> {
        if self.count == 0 {
            Err("count: 0, expected 1 or more".into())
        } else {
            Ok(())
        }
    }
}

#[test]
fn both_formats_give_back_the_same_message() {
    for format in [Format::Bincode, Format::Json] {
        let bytes = encode(&reading(), format).unwrap();
        let back: Reading =
            decode_marked(&bytes, &encoding::<Reading>(format), MAX_PAYLOAD_BYTES).unwrap();
        assert_eq!(back, reading());
    }
}

#[test]
fn floats_survive_json_bit_for_bit() {
    for x in [
        0.1 + 0.2,
        f64::MIN_POSITIVE,
        5e-324,
        f64::MAX,
        -0.0,
        1.0 / 3.0,
    ] {
        let message = Reading {
            position_m: [x; 3],
            ..reading()
        };
        let bytes = encode(&message, Format::Json).unwrap();
        let back: Reading = decode(&bytes, Format::Json, MAX_PAYLOAD_BYTES).unwrap();
        assert_eq!(back.position_m[0].to_bits(), x.to_bits());
    }
}

#[test]
fn binary_layout_is_frozen() {
    let fault = Fault::new("arm", "busy", "no").with("n", 1.0);
    let expected: &[u8] = &[
        4, b'b', b'u', b's', b'y', 3, b'a', b'r', b'm', 2, b'n', b'o', 1, 1, b'n', 0, 0, 0, 0, 0,
        0, 0xF0, 0x3F,
    ];
    assert_eq!(encode(&fault, Format::Bincode).unwrap(), expected);
    assert_eq!(
        encode(&Nothing {}, Format::Bincode).unwrap(),
        Vec::<u8>::new()
    );
    let pixels: &[u8] = &encode(&reading(), Format::Bincode).unwrap()[24..];
    assert_eq!(pixels[..5], [4, 0, 1, 254, 255]);
}

#[test]
fn pixels_are_base64_in_json() {
    let text = String::from_utf8(encode(&reading(), Format::Json).unwrap()).unwrap();
    assert!(text.contains(r#""pixels":"AAH+/w==""#), "{text}");
    let bad = text.replace("AAH+/w==", "AAH");
    let e = decode::<Reading>(bad.as_bytes(), Format::Json, 1000).unwrap_err();
    assert!(e.to_string().contains("not base64"), "{e}");
}

#[test]
fn wrong_name_or_version_is_refused_with_found_and_expected() {
    let bytes = encode(&reading(), Format::Bincode).unwrap();
    for mark in [
        "application/bincode;reading/1",
        "application/bincode;other/2",
        BINCODE,
    ] {
        let e = decode_marked::<Reading>(&bytes, mark, 1000).unwrap_err();
        assert_eq!(e.fault_name(), "wrong_version");
        let text = e.to_string();
        assert!(
            text.contains(mark) && text.contains("application/bincode;reading/2"),
            "{text}"
        );
    }
    let e = check_encoding("application/json;reading/1", "reading/2").unwrap_err();
    assert_eq!(e.fault_name(), "wrong_version");
    assert_eq!(
        check_encoding("application/json;reading/2", "reading/2"),
        Ok(Format::Json)
    );
    let e = check_encoding("image/png", "reading/2").unwrap_err();
    assert_eq!(e.fault_name(), "bad_payload");
}

#[test]
fn oversize_is_refused_before_decoding() {
    let e = decode::<Reading>(&[0xFF; 101], Format::Bincode, 100).unwrap_err();
    assert_eq!(
        e,
        CodecError::TooLarge {
            schema: "reading/2".into(),
            found: 101,
            limit: 100
        }
    );
    let big = Reading {
        pixels: vec![0; MAX_PAYLOAD_BYTES],
        ..reading()
    };
    assert_eq!(
        encode(&big, Format::Bincode).unwrap_err().fault_name(),
        "payload_too_large"
    );
}

#[test]
fn a_claimed_length_cannot_allocate_more_than_the_limit() {
    // 24 bytes of position, then pixels of 2^60 bytes
    let mut bytes = vec![0; 24];
    bytes.extend([253, 0, 0, 0, 0, 0, 0, 0, 0x10]);
    let e = decode::<Reading>(&bytes, Format::Bincode, 1000).unwrap_err();
    assert!(
        matches!(e, CodecError::Malformed { bytes: 33, .. }),
        "{e:?}"
    );
}

#[test]
fn bytes_after_the_message_are_refused() {
    let mut bytes = encode(&reading(), Format::Bincode).unwrap();
    let used = bytes.len();
    bytes.push(0);
    let e = decode::<Reading>(&bytes, Format::Bincode, 1000).unwrap_err();
    assert_eq!(
        e,
        CodecError::TrailingBytes {
            schema: "reading/2".into(),
            used,
            bytes: used + 1
        }
    );
    let mut text = encode(&reading(), Format::Json).unwrap();
    text.extend(b" {}");
    assert!(decode::<Reading>(&text, Format::Json, 1000).is_err());
}

#[test]
fn numbers_must_be_finite_in_both_formats_and_directions() {
    let mut message = reading();
    message.position_m[2] = f64::NAN;
    for format in [Format::Bincode, Format::Json] {
        let e = encode(&message, format).unwrap_err();
        assert_eq!(
            e.to_string(),
            "reading/2: position_m[2]: NaN, expected a finite number"
        );
    }
    let raw = bincode::serde::encode_to_vec(&message, bincode::config::standard()).unwrap();
    let e = decode::<Reading>(&raw, Format::Bincode, 1000).unwrap_err();
    assert!(e.to_string().contains("position_m[2]: NaN"), "{e}");
    message = Reading {
        note: Some(f64::INFINITY),
        ..reading()
    };
    let e = encode(&message, Format::Json).unwrap_err();
    assert!(e.to_string().contains("note: inf"), "{e}");
    for text in [
        r#"{"name":"a","service":"b","message":"c","details":{"x_m":NaN}}"#,
        r#"{"name":"a","service":"b","message":"c","details":{"x_m":1e999}}"#,
        r#"{"name":"a","service":"b","message":"c","details":{"x_m":null}}"#,
    ] {
        let e = decode::<Fault>(text.as_bytes(), Format::Json, 1000).unwrap_err();
        assert_eq!(e.fault_name(), "bad_payload");
    }
    let fault = Fault::new("a", "b", "c").with("x_m", f64::NEG_INFINITY);
    let e = encode(&fault, Format::Json).unwrap_err();
    assert!(e.to_string().contains(r#"details["x_m"]: -inf"#), "{e}");
}

#[test]
fn a_message_without_meaning_is_refused_in_both_directions() {
    let e = encode(&Checked { count: 0 }, Format::Json).unwrap_err();
    assert_eq!(e.to_string(), "checked/1: count: 0, expected 1 or more");
    let e = decode::<Checked>(br#"{"count":0}"#, Format::Json, 100).unwrap_err();
    assert_eq!(e.fault_name(), "bad_payload");
}

#[test]
fn malformed_json_says_where() {
    let e = decode::<Checked>(b"{\"count\":\n x}", Format::Json, 100).unwrap_err();
    assert!(e.to_string().contains("line 2 column 2"), "{e}");
}
