//! Finds a number that is not finite anywhere inside a value.
//!
//! JSON has no NaN and no infinity: serde_json would write `null` in their place. Binary payloads
//! could carry them unnoticed. So every message is walked once; a block of bytes costs one call.

use serde::{Serialize, ser};
use std::fmt;

/// A number that is not finite, and the way to it.
#[derive(Clone, Debug, PartialEq)]
pub struct NotFinite {
    /// Path from the inside out.
    steps: Vec<String>,
    found: String,
}

impl fmt::Display for NotFinite {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let path: String = self.steps.iter().rev().map(String::as_str).collect();
        let path = path.strip_prefix('.').unwrap_or(&path);
        write!(f, "{path}: {}, expected a finite number", self.found)
    }
}

impl std::error::Error for NotFinite {}

impl ser::Error for NotFinite {
    fn custom<T: fmt::Display>(message: T) -> Self {
        Self {
            steps: Vec::new(),
            found: message.to_string(),
        }
    }
}

/// Checks that every floating-point number in `value` is finite.
///
/// # Errors
/// The path to the first one that is not, e.g. `goal.axis[2]: NaN, expected a finite number`.
pub fn check_finite<T: Serialize + ?Sized>(value: &T) -> Result<(), NotFinite> {
    value.serialize(Walk)
}

/// Visits a value and keeps nothing of it.
struct Walk;

/// Visits the members of a composite value and counts them for the path.
struct Members(usize);

impl Members {
    fn visit<T: Serialize + ?Sized>(
        &mut self,
        value: &T,
        step: impl FnOnce(usize) -> String,
    ) -> Result<(), NotFinite> {
        let index = self.0;
        self.0 += 1;
        value.serialize(Walk).map_err(|mut e| {
            e.steps.push(step(index));
            e
        })
    }
}

fn at(index: usize) -> String {
    format!("[{index}]")
}

macro_rules! nothing_to_check {
    ($($method:ident($($kind:ty)?)),* $(,)?) => {$(
        fn $method(self $(, _: $kind)?) -> Result<(), NotFinite> { Ok(()) }
    )*};
}

impl ser::Serializer for Walk {
    type Ok = ();
    type Error = NotFinite;
    type SerializeSeq = Members;
    type SerializeTuple = Members;
    type SerializeTupleStruct = Members;
    type SerializeTupleVariant = Members;
    type SerializeMap = Members;
    type SerializeStruct = Members;
    type SerializeStructVariant = Members;

    nothing_to_check! {
        serialize_bool(bool), serialize_i8(i8), serialize_i16(i16), serialize_i32(i32),
        serialize_i64(i64), serialize_i128(i128), serialize_u8(u8), serialize_u16(u16),
        serialize_u32(u32), serialize_u64(u64), serialize_u128(u128), serialize_char(char),
        serialize_str(&str), serialize_bytes(&[u8]), serialize_none(), serialize_unit(),
        serialize_unit_struct(&'static str),
    }

    fn serialize_f32(self, v: f32) -> Result<(), NotFinite> {
        self.serialize_f64(f64::from(v))
    }
    fn serialize_f64(self, v: f64) -> Result<(), NotFinite> {
        if v.is_finite() {
            Ok(())
        } else {
            Err(NotFinite {
                steps: Vec::new(),
                found: v.to_string(),
            })
        }
    }
    fn serialize_some<T: Serialize + ?Sized>(self, value: &T) -> Result<(), NotFinite> {
        value.serialize(self)
    }
    fn serialize_unit_variant(
        self,
        _: &'static str,
        _: u32,
        _: &'static str,
    ) -> Result<(), NotFinite> {
        Ok(())
    }
    fn serialize_newtype_struct<T: Serialize + ?Sized>(
        self,
        _: &'static str,
        value: &T,
    ) -> Result<(), NotFinite> {
        value.serialize(self)
    }
    fn serialize_newtype_variant<T: Serialize + ?Sized>(
        self,
        _: &'static str,
        _: u32,
        variant: &'static str,
        value: &T,
    ) -> Result<(), NotFinite> {
        Members(0).visit(value, |_| format!(".{variant}"))
    }
    fn serialize_seq(self, _: Option<usize>) -> Result<Members, NotFinite> {
        Ok(Members(0))
    }
    fn serialize_tuple(self, _: usize) -> Result<Members, NotFinite> {
        Ok(Members(0))
    }
    fn serialize_tuple_struct(self, _: &'static str, _: usize) -> Result<Members, NotFinite> {
        Ok(Members(0))
    }
    fn serialize_tuple_variant(
        self,
        _: &'static str,
        _: u32,
        _: &'static str,
        _: usize,
    ) -> Result<Members, NotFinite> {
        Ok(Members(0))
    }
    fn serialize_map(self, _: Option<usize>) -> Result<Members, NotFinite> {
        Ok(Members(0))
    }
    fn serialize_struct(self, _: &'static str, _: usize) -> Result<Members, NotFinite> {
        Ok(Members(0))
    }
    fn serialize_struct_variant(
        self,
        _: &'static str,
        _: u32,
        _: &'static str,
        _: usize,
    ) -> Result<Members, NotFinite> {
        Ok(Members(0))
    }
    fn is_human_readable(&self) -> bool {
        false
    }
}

macro_rules! by_index {
    ($($kind:ident :: $method:ident),*) => {$(
        impl ser::$kind for Members {
            type Ok = ();
            type Error = NotFinite;
            fn $method<T: Serialize + ?Sized>(&mut self, value: &T) -> Result<(), NotFinite> {
                self.visit(value, at)
            }
            fn end(self) -> Result<(), NotFinite> { Ok(()) }
        }
    )*};
}
by_index!(
    SerializeSeq::serialize_element,
    SerializeTuple::serialize_element,
    SerializeTupleStruct::serialize_field,
    SerializeTupleVariant::serialize_field
);

macro_rules! by_name {
    ($($kind:ident),*) => {$(
        impl ser::$kind for Members {
            type Ok = ();
            type Error = NotFinite;
            fn serialize_field<T: Serialize + ?Sized>(
                &mut self,
                name: &'static str,
                value: &T,
            ) -> Result<(), NotFinite> {
                self.visit(value, |_| format!(".{name}"))
            }
            fn end(self) -> Result<(), NotFinite> { Ok(()) }
        }
    )*};
}
by_name!(SerializeStruct, SerializeStructVariant);

impl ser::SerializeMap for Members {
    type Ok = ();
    type Error = NotFinite;
    fn serialize_key<T: Serialize + ?Sized>(&mut self, _: &T) -> Result<(), NotFinite> {
        Ok(())
    }
    fn serialize_value<T: Serialize + ?Sized>(&mut self, value: &T) -> Result<(), NotFinite> {
        self.visit(value, at)
    }
    fn serialize_entry<K: Serialize + ?Sized, V: Serialize + ?Sized>(
        &mut self,
        key: &K,
        value: &V,
    ) -> Result<(), NotFinite> {
        self.visit(value, |i| match serde_json::to_string(key) {
            Ok(key) => format!("[{key}]"),
            Err(_) => at(i),
        })
    }
    fn end(self) -> Result<(), NotFinite> {
        Ok(())
    }
}
