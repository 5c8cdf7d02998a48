//! Questions and answers as payloads: which format, which schema, which fault.

use rover_messages::{
    Fault, Wire,
    codec::{self, CodecError, Format},
};
use serde::{Serialize, de::DeserializeOwned};
use std::{borrow::Cow, sync::Arc};
use zenoh::{Wait, bytes::ZBytes, key_expr::KeyExpr, query::Query};

/// A message, or an action's envelope around messages, whose schema names what is inside.
pub(crate) trait Form: Serialize + DeserializeOwned + Send + Sync + 'static {
    fn schema() -> Cow<'static, str>;
    fn check(&self) -> Result<(), String>;
}

impl<T: Wire> Form for T {
    fn schema() -> Cow<'static, str> {
        T::SCHEMA.into()
    }
    fn check(&self) -> Result<(), String> {
        self.validate()
    }
}

/// Writes a checked message.
pub(crate) fn write<T: Form>(message: &T, format: Format) -> Result<Vec<u8>, CodecError> {
    let schema = T::schema();
    message.check().map_err(|reason| CodecError::Invalid {
        schema: schema.to_string(),
        reason,
    })?;
    codec::encode_value(message, &schema, format)
}

/// Writes a value under the schema of another one with the same bytes.
pub(crate) fn write_as<T: Form>(
    message: &T,
    schema: &str,
    format: Format,
) -> Result<Vec<u8>, CodecError> {
    message.check().map_err(|reason| CodecError::Invalid {
        schema: schema.to_owned(),
        reason,
    })?;
    codec::encode_value(message, schema, format)
}

/// Binary payload of a value, and its mark.
pub(crate) fn write_marked<T: Serialize>(
    value: &T,
    schema: &str,
) -> Result<(Vec<u8>, String), CodecError> {
    let bytes = codec::encode_value(value, schema, Format::Bincode)?;
    Ok((bytes, codec::encoding_of(schema, Format::Bincode)))
}

/// What can be asked: gives its binary payload and mark.
pub(crate) trait Question {
    fn bytes(&self) -> Result<(Vec<u8>, String), CodecError>;
}

impl<T: Form> Question for T {
    fn bytes(&self) -> Result<(Vec<u8>, String), CodecError> {
        let schema = T::schema();
        self.check().map_err(|reason| CodecError::Invalid {
            schema: schema.to_string(),
            reason,
        })?;
        write_marked(self, &schema)
    }
}

/// Reads and checks a message whose payload is marked `encoding`.
pub(crate) fn read<T: Form>(bytes: &[u8], encoding: &str, limit: usize) -> Result<T, CodecError> {
    let schema = T::schema();
    let format = codec::check_encoding(encoding, &schema)?;
    let message: T = codec::decode_value(bytes, &schema, format, limit)?;
    message.check().map_err(|reason| CodecError::Invalid {
        schema: schema.into(),
        reason,
    })?;
    Ok(message)
}

/// Whether a query may only read: its key has wildcards, so it names no server.
pub(crate) fn is_wild(query: &Query, key: &KeyExpr<'static>) -> bool {
    query.key_expr() != key
}

/// Format in which the asker wants the answer: the selector parameter `encoding=bincode|json`,
/// else that of his payload, else JSON.
pub(crate) fn asked_format(query: &Query) -> Format {
    match query.parameters().get("encoding") {
        Some("bincode") => Format::Bincode,
        Some("json") => Format::Json,
        _ => query
            .encoding()
            .map_or(Format::Json, |e| codec::format_of(&e.to_string())),
    }
}

/// Reads a question; no payload counts as the JSON text `{}`.
pub(crate) fn question<Q: Form>(query: &Query, limit: usize, by: &str) -> Result<Q, Fault> {
    let payload = query.payload().map(ZBytes::to_bytes).unwrap_or_default();
    let encoding = query
        .encoding()
        .map(ToString::to_string)
        .unwrap_or_default();
    let result = if payload.is_empty() && codec::format_of(&encoding) == Format::Json {
        read(b"{}", codec::JSON, limit)
    } else {
        read(&payload, &encoding, limit)
    };
    result.map_err(|e| {
        Fault::new(
            by,
            e.fault_name(),
            format!("{}: {e}", query.key_expr().as_str()),
        )
    })
}

/// The answering side of one key.
#[derive(Clone)]
pub(crate) struct Desk {
    pub(crate) name: Arc<str>,
    pub(crate) key: KeyExpr<'static>,
}

impl Desk {
    /// Answers with a message; one that cannot be encoded becomes the fault `bad_answer`.
    pub(crate) fn answer<A: Form>(&self, query: &Query, message: &A, format: Format) {
        match write(message, format) {
            Ok(bytes) => self.answer_bytes(query, bytes, codec::encoding_of(&A::schema(), format)),
            Err(e) => {
                let text = format!("{}: {e}", self.key.as_str());
                self.refuse(query, &Fault::new(&self.name, "bad_answer", text), format);
            }
        }
    }

    /// Answers with ready bytes.
    pub(crate) fn answer_bytes(
        &self,
        query: &Query,
        bytes: impl Into<ZBytes>,
        encoding: impl Into<zenoh::bytes::Encoding>,
    ) {
        let reply = query.reply(&self.key, bytes).encoding(encoding);
        if let Err(e) = reply.attachment(self.name.as_bytes()).wait() {
            tracing::debug!(key = self.key.as_str(), "answer not sent: {e}");
        }
    }

    /// Answers with a fault.
    pub(crate) fn refuse(&self, query: &Query, fault: &Fault, format: Format) {
        tracing::debug!(key = self.key.as_str(), %fault, "refused");
        let (bytes, encoding) = match write(fault, format) {
            Ok(bytes) => (bytes, codec::encoding::<Fault>(format)),
            Err(_) => (finite_fault(fault), codec::JSON.to_owned()),
        };
        if let Err(e) = query.reply_err(bytes).encoding(encoding).wait() {
            tracing::debug!(key = self.key.as_str(), "refusal not sent: {e}");
        }
    }

    /// A fault raised by the bus itself on this key.
    pub(crate) fn fault(&self, name: &str, message: impl Into<String>) -> Fault {
        Fault::new(
            &self.name,
            name,
            format!("{}: {}", self.key.as_str(), message.into()),
        )
    }
}

/// JSON of a fault whose details hold numbers that are not finite: these move into the message.
fn finite_fault(fault: &Fault) -> Vec<u8> {
    let mut fault = fault.clone();
    let odd: Vec<(String, f64)> = fault
        .details
        .iter()
        .filter(|(_, v)| !v.is_finite())
        .map(|(k, v)| (k.clone(), *v))
        .collect();
    for (key, value) in odd {
        fault.details.remove(&key);
        fault.message.push_str(&format!(" [{key} = {value}]"));
    }
    serde_json::to_vec(&fault).unwrap_or_default()
}
