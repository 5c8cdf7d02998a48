//! Payload bytes: bincode between services, JSON for everybody else.
//!
//! A binary payload is marked `application/bincode;<schema>`, where the schema is the message's
//! name and version ([`Wire::SCHEMA`]); another name or version is refused before a byte is
//! decoded. JSON is marked `application/json`. Decoding goes through the same steps in both:
//! size limit, decoding, no bytes left over, finite numbers, then the message's own
//! [`Wire::validate`]. The binary layout is bincode 2 `standard` (little endian, variable length
//! integers, fields in the order of declaration).

mod finite;

use crate::Wire;
use base64::{Engine, engine::general_purpose::STANDARD};
use serde::{Serialize, de::DeserializeOwned};
use thiserror::Error;

pub use finite::{NotFinite, check_finite};

/// Largest payload that is encoded or decoded at all, in bytes.
pub const MAX_PAYLOAD_BYTES: usize = 16 * 1024 * 1024;

/// Media type of the binary encoding, without schema.
pub const BINCODE: &str = "application/bincode";
/// Media type of the JSON encoding.
pub const JSON: &str = "application/json";

/// How a message is written as bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// bincode 2, between services.
    Bincode,
    /// JSON text, for people and foreign programs.
    Json,
}

/// Why bytes are not the expected message, or a message cannot become bytes.
#[derive(Clone, Debug, PartialEq, Error)]
pub enum CodecError {
    /// More bytes than allowed.
    #[error("{schema}: payload of {found} bytes, expected at most {limit} bytes")]
    TooLarge {
        /// Expected schema.
        schema: String,
        /// Bytes found.
        found: usize,
        /// Bytes allowed.
        limit: usize,
    },
    /// Another message, or another version of it.
    #[error("payload is marked `{found}`, expected `{expected}`")]
    WrongVersion {
        /// Encoding found.
        found: String,
        /// Encoding expected.
        expected: String,
    },
    /// An encoding that is neither bincode nor JSON.
    #[error("payload is marked `{found}`, expected `application/bincode;{schema}` or JSON text")]
    UnknownEncoding {
        /// Encoding found.
        found: String,
        /// Expected schema.
        schema: String,
    },
    /// The bytes do not decode.
    #[error("{schema}: payload of {bytes} bytes does not decode as {format:?}: {reason}")]
    Malformed {
        /// Expected schema.
        schema: String,
        /// Expected format.
        format: Format,
        /// Length of the payload.
        bytes: usize,
        /// What the decoder found and where.
        reason: String,
    },
    /// The message was complete before the bytes were.
    #[error("{schema}: message ends after {used} of {bytes} bytes, expected no bytes after it")]
    TrailingBytes {
        /// Expected schema.
        schema: String,
        /// Bytes the message took.
        used: usize,
        /// Bytes found.
        bytes: usize,
    },
    /// Decoded, but it does not make sense, or a number in it is not finite.
    #[error("{schema}: {reason}")]
    Invalid {
        /// Schema of the message.
        schema: String,
        /// Field, what was found, what was expected.
        reason: String,
    },
    /// The message cannot be written in this format.
    #[error("{schema}: cannot be encoded as {format:?}: {reason}")]
    Unencodable {
        /// Schema of the message.
        schema: String,
        /// Wanted format.
        format: Format,
        /// The encoder's reason.
        reason: String,
    },
}

impl CodecError {
    /// Name of the fault that answers such a payload: `payload_too_large`, `wrong_version` or
    /// `bad_payload`.
    pub fn fault_name(&self) -> &'static str {
        match self {
            Self::TooLarge { .. } => "payload_too_large",
            Self::WrongVersion { .. } => "wrong_version",
            _ => "bad_payload",
        }
    }
}

/// The encoding that marks a payload of `T`.
pub fn encoding<T: Wire>(format: Format) -> String {
    encoding_of(T::SCHEMA, format)
}

/// The encoding that marks a payload of the message named `schema`.
pub fn encoding_of(schema: &str, format: Format) -> String {
    match format {
        Format::Bincode => format!("{BINCODE};{schema}"),
        Format::Json => JSON.to_owned(),
    }
}

/// Format in which somebody who marked his payload with `encoding` wants to be answered.
pub fn format_of(encoding: &str) -> Format {
    if media_type(encoding) == BINCODE {
        Format::Bincode
    } else {
        Format::Json
    }
}

/// Checks the mark of a payload against the expected schema and says how to decode it.
///
/// Unmarked bytes and text count as JSON. JSON may carry a schema; then it must be the right one.
///
/// # Errors
/// [`CodecError::WrongVersion`] for another schema, a binary payload without one included;
/// [`CodecError::UnknownEncoding`] for anything that is neither bincode nor text.
pub fn check_encoding(encoding: &str, schema: &str) -> Result<Format, CodecError> {
    let found = encoding.split_once(';').map(|(_, schema)| schema.trim());
    let wrong = |format| CodecError::WrongVersion {
        found: encoding.to_owned(),
        expected: match format {
            Format::Bincode => encoding_of(schema, format),
            Format::Json => format!("{JSON};{schema}"),
        },
    };
    match media_type(encoding) {
        BINCODE if found == Some(schema) => Ok(Format::Bincode),
        BINCODE => Err(wrong(Format::Bincode)),
        JSON | "text/json" => match found {
            None => Ok(Format::Json),
            Some(s) if s == schema || s.starts_with("charset") => Ok(Format::Json),
            Some(_) => Err(wrong(Format::Json)),
        },
        "" | "zenoh/bytes" | "zenoh/string" | "text/plain" | "application/octet-stream" => {
            Ok(Format::Json)
        }
        _ => Err(CodecError::UnknownEncoding {
            found: encoding.to_owned(),
            schema: schema.to_owned(),
        }),
    }
}

fn media_type(encoding: &str) -> &str {
    encoding.split(';').next().unwrap_or_default().trim()
}

/// Writes a message as bytes after checking it.
///
/// # Errors
/// [`CodecError::Invalid`] if its own check refuses it or a number is not finite,
/// [`CodecError::TooLarge`] above [`MAX_PAYLOAD_BYTES`].
pub fn encode<T: Wire>(message: &T, format: Format) -> Result<Vec<u8>, CodecError> {
    message.validate().map_err(|reason| CodecError::Invalid {
        schema: T::SCHEMA.to_owned(),
        reason,
    })?;
    encode_value(message, T::SCHEMA, format)
}

/// Reads a message from bytes and checks it; `limit` is the largest length allowed, in bytes.
///
/// # Errors
/// See [`CodecError`]; nothing is decoded from a payload that is too large.
pub fn decode<T: Wire>(bytes: &[u8], format: Format, limit: usize) -> Result<T, CodecError> {
    let message: T = decode_value(bytes, T::SCHEMA, format, limit)?;
    message.validate().map_err(|reason| CodecError::Invalid {
        schema: T::SCHEMA.to_owned(),
        reason,
    })?;
    Ok(message)
}

/// Reads a message whose mark is `encoding`; see [`check_encoding`] and [`decode`].
///
/// # Errors
/// See [`CodecError`].
pub fn decode_marked<T: Wire>(bytes: &[u8], encoding: &str, limit: usize) -> Result<T, CodecError> {
    decode(bytes, check_encoding(encoding, T::SCHEMA)?, limit)
}

/// As [`encode`], for a value around a message (an action's goal, progress) whose schema is only
/// known at run time; the caller checks its meaning.
///
/// # Errors
/// See [`encode`].
pub fn encode_value<T: Serialize>(
    value: &T,
    schema: &str,
    format: Format,
) -> Result<Vec<u8>, CodecError> {
    check_finite(value).map_err(|e| CodecError::Invalid {
        schema: schema.to_owned(),
        reason: e.to_string(),
    })?;
    let bytes = match format {
        Format::Bincode => bincode::serde::encode_to_vec(value, bincode::config::standard())
            .map_err(|e| e.to_string()),
        Format::Json => serde_json::to_vec(value).map_err(|e| e.to_string()),
    }
    .map_err(|reason| CodecError::Unencodable {
        schema: schema.to_owned(),
        format,
        reason,
    })?;
    check_size(bytes.len(), schema, MAX_PAYLOAD_BYTES)?;
    Ok(bytes)
}

/// As [`decode`], for a value around a message whose schema is only known at run time; the caller
/// checks its meaning.
///
/// # Errors
/// See [`decode`].
pub fn decode_value<T: DeserializeOwned + Serialize>(
    bytes: &[u8],
    schema: &str,
    format: Format,
    limit: usize,
) -> Result<T, CodecError> {
    check_size(bytes.len(), schema, limit.min(MAX_PAYLOAD_BYTES))?;
    let malformed = |reason: String| CodecError::Malformed {
        schema: schema.to_owned(),
        format,
        bytes: bytes.len(),
        reason,
    };
    match format {
        Format::Json => serde_json::from_slice(bytes).map_err(|e| malformed(e.to_string())),
        Format::Bincode => {
            let config = bincode::config::standard().with_limit::<MAX_PAYLOAD_BYTES>();
            let (value, used) = bincode::serde::decode_from_slice::<T, _>(bytes, config)
                .map_err(|e| malformed(e.to_string()))?;
            if used != bytes.len() {
                return Err(CodecError::TrailingBytes {
                    schema: schema.to_owned(),
                    used,
                    bytes: bytes.len(),
                });
            }
            check_finite(&value).map_err(|e| CodecError::Invalid {
                schema: schema.to_owned(),
                reason: e.to_string(),
            })?;
            Ok(value)
        }
    }
}

fn check_size(found: usize, schema: &str, limit: usize) -> Result<(), CodecError> {
    if found > limit {
        return Err(CodecError::TooLarge {
            schema: schema.to_owned(),
            found,
            limit,
        });
    }
    Ok(())
}

/// For fields of bytes, `#[serde(with = "bytes_or_base64")]`: plain bytes in binary formats, one
/// base64 string in JSON.
pub mod bytes_or_base64 {
    use super::{Engine, STANDARD};
    use serde::{Deserialize, Deserializer, Serializer, de::Error};

    /// Writes bytes.
    ///
    /// # Errors
    /// Those of the serializer.
    pub fn serialize<B: AsRef<[u8]>, S: Serializer>(bytes: &B, to: S) -> Result<S::Ok, S::Error> {
        if to.is_human_readable() {
            to.serialize_str(&STANDARD.encode(bytes.as_ref()))
        } else {
            to.serialize_bytes(bytes.as_ref())
        }
    }

    /// Reads bytes.
    ///
    /// # Errors
    /// Those of the deserializer; text that is not base64.
    pub fn deserialize<'de, B: From<Vec<u8>>, D: Deserializer<'de>>(
        from: D,
    ) -> Result<B, D::Error> {
        if from.is_human_readable() {
            let text = String::deserialize(from)?;
            let bytes = STANDARD.decode(text.as_bytes()).map_err(|e| {
                D::Error::custom(format!(
                    "text of {} characters is not base64: {e}",
                    text.len()
                ))
            })?;
            Ok(bytes.into())
        } else {
            Ok(serde_bytes::ByteBuf::deserialize(from)?.into_vec().into())
        }
    }
}

#[cfg(test)]
mod tests;
