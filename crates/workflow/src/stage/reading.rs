//! Reads JSON into a typed value. Errors are data with words of our own, so that nobody has to take a message
//! of `serde` apart.

use std::fmt::{self, Display};

use serde::de::value::{MapAccessDeserializer, MapDeserializer, SeqDeserializer};
use serde::de::{DeserializeOwned, Expected, IntoDeserializer, Unexpected, Visitor};
use serde::{Deserializer, de, forward_to_deserialize_any};
use serde_json::Value;

use crate::error::{ParameterError, Problem};

/// Reads a value of the type `T`.
///
/// # Errors
/// The path of the first field that does not fit, with the problem.
pub fn read<T: DeserializeOwned>(value: &Value) -> Result<T, ParameterError> {
    serde_path_to_error::deserialize(Json(value)).map_err(|error| {
        let path = error.path().to_string();
        let mut path = if path == "." { String::new() } else { path };
        let Misfit { problem, message } = error.into_inner();
        // An unknown key is reported at its own path by some containers and at its parent's by others.
        if let Problem::UnknownKey { name, .. } = &problem
            && path != *name
            && !path.ends_with(&format!(".{name}"))
        {
            let parent = path.trim_end_matches('?').trim_end_matches('.');
            path = if parent.is_empty() { name.clone() } else { format!("{parent}.{name}") };
        }
        ParameterError { path, message, problem }
    })
}

/// A value that does not fit its type.
#[derive(Debug)]
struct Misfit {
    problem: Problem,
    message: String,
}

impl Misfit {
    /// Another type or value than the expected one.
    fn other(found: &Unexpected<'_>, expected: &dyn Expected) -> Self {
        let expected = expected.to_string();
        let expected = match expected.as_str() {
            "u8" | "u16" | "u32" | "u64" | "usize" => "a whole number, 0 or more",
            "i8" | "i16" | "i32" | "i64" | "isize" => "a whole number",
            "f32" | "f64" => "a number",
            "a boolean" => "true or false",
            "a string" | "string" => "text",
            other if other.starts_with("struct ") => "a table",
            other if other.starts_with("a sequence") => "a list",
            other => other,
        };
        let found = match found {
            Unexpected::Bool(value) => value.to_string(),
            Unexpected::Unsigned(value) => value.to_string(),
            Unexpected::Signed(value) => value.to_string(),
            Unexpected::Float(value) => Value::from(*value).to_string(),
            Unexpected::Str(text) => format!("{text:?}"),
            Unexpected::Unit | Unexpected::Option => "nothing".to_string(),
            Unexpected::Map => "a table".to_string(),
            Unexpected::Seq => "a list".to_string(),
            other => other.to_string(),
        };
        let problem = if expected == "text" { Problem::NoText } else { Problem::Value };
        Self { problem, message: format!("expected {expected}, found {found}") }
    }
}

/// The known names, as a sentence goes on with them.
fn listed(names: &[&str]) -> String {
    let quoted = |name: &&str| format!("`{name}`");
    match names {
        [] => "there are none".to_string(),
        [only] => format!("expected `{only}`"),
        [one, other] => format!("expected `{one}` or `{other}`"),
        _ => format!("expected one of {}", names.iter().map(quoted).collect::<Vec<_>>().join(", ")),
    }
}

impl Display for Misfit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.message)
    }
}

impl std::error::Error for Misfit {}

impl de::Error for Misfit {
    fn custom<T: Display>(message: T) -> Self {
        Self { problem: Problem::Value, message: message.to_string() }
    }

    fn invalid_type(found: Unexpected<'_>, expected: &dyn Expected) -> Self {
        Self::other(&found, expected)
    }

    fn invalid_value(found: Unexpected<'_>, expected: &dyn Expected) -> Self {
        Self::other(&found, expected)
    }

    fn unknown_field(field: &str, expected: &'static [&'static str]) -> Self {
        let known = expected.iter().map(ToString::to_string).collect();
        let message = format!("unknown field `{field}`, {}", listed(expected));
        Self { problem: Problem::UnknownKey { name: field.to_string(), known }, message }
    }

    fn unknown_variant(variant: &str, expected: &'static [&'static str]) -> Self {
        let known = expected.iter().map(ToString::to_string).collect();
        let message = format!("`{variant}` is not known here; {}", listed(expected));
        Self { problem: Problem::UnknownChoice { name: variant.to_string(), known }, message }
    }

    fn missing_field(field: &'static str) -> Self {
        Self { problem: Problem::Missing(field), message: format!("missing field `{field}`") }
    }
}

/// A JSON value to read from.
struct Json<'a>(&'a Value);

impl<'de> IntoDeserializer<'de, Misfit> for Json<'de> {
    type Deserializer = Self;

    fn into_deserializer(self) -> Self {
        self
    }
}

impl<'de> Json<'de> {
    fn fields(
        map: &'de serde_json::Map<String, Value>,
    ) -> MapDeserializer<'de, impl Iterator<Item = (&'de str, Self)>, Misfit> {
        MapDeserializer::new(map.iter().map(|(name, value)| (name.as_str(), Self(value))))
    }
}

impl<'de> Deserializer<'de> for Json<'de> {
    type Error = Misfit;

    fn deserialize_any<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, Misfit> {
        match self.0 {
            Value::Null => visitor.visit_unit(),
            Value::Bool(value) => visitor.visit_bool(*value),
            Value::Number(number) => match (number.as_u64(), number.as_i64(), number.as_f64()) {
                (Some(value), ..) => visitor.visit_u64(value),
                (_, Some(value), _) => visitor.visit_i64(value),
                (_, _, value) => visitor.visit_f64(value.unwrap_or(f64::NAN)),
            },
            Value::String(text) => visitor.visit_borrowed_str(text),
            Value::Array(items) => {
                let mut items = SeqDeserializer::new(items.iter().map(Json));
                let value = visitor.visit_seq(&mut items)?;
                items.end()?;
                Ok(value)
            }
            Value::Object(map) => {
                let mut fields = Self::fields(map);
                let value = visitor.visit_map(&mut fields)?;
                fields.end()?;
                Ok(value)
            }
        }
    }

    fn deserialize_option<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, Misfit> {
        if self.0.is_null() { visitor.visit_none() } else { visitor.visit_some(self) }
    }

    fn deserialize_newtype_struct<V: Visitor<'de>>(
        self,
        _name: &'static str,
        visitor: V,
    ) -> Result<V::Value, Misfit> {
        visitor.visit_newtype_struct(self)
    }

    fn deserialize_enum<V: Visitor<'de>>(
        self,
        _name: &'static str,
        _variants: &'static [&'static str],
        visitor: V,
    ) -> Result<V::Value, Misfit> {
        match self.0 {
            Value::String(text) => visitor.visit_enum(text.as_str().into_deserializer()),
            Value::Object(map) if map.len() == 1 => {
                visitor.visit_enum(MapAccessDeserializer::new(Self::fields(map)))
            }
            _ => self.deserialize_any(visitor),
        }
    }

    forward_to_deserialize_any! {
        bool i8 i16 i32 i64 i128 u8 u16 u32 u64 u128 f32 f64 char str string bytes byte_buf unit unit_struct
        seq tuple tuple_struct map struct identifier ignored_any
    }
}

#[cfg(test)]
mod tests {
    use serde::Deserialize;
    use serde_json::json;

    use super::*;

    #[derive(Debug, Deserialize, PartialEq)]
    #[serde(rename_all = "lowercase")]
    enum OneOf {
        One,
        Two(f32),
        Three { deep: u8 },
    }

    #[derive(Debug, Default, Deserialize, PartialEq)]
    #[serde(deny_unknown_fields, default)]
    struct Inner {
        size: Option<String>,
        pair: [f64; 2],
    }

    #[derive(Debug, Deserialize, PartialEq)]
    #[serde(deny_unknown_fields)]
    struct Outer {
        count: usize,
        #[serde(default)]
        inner: Inner,
        #[serde(default)]
        choices: Vec<OneOf>,
    }

    #[test]
    fn values_are_read_as_serde_json_reads_them() {
        let value = json!({
            "count": 3,
            "inner": {"size": "a", "pair": [1, -2.5]},
            "choices": ["one", {"two": 2}, {"three": {"deep": 7}}],
        });
        let read: Outer = read(&value).expect("it fits");
        assert_eq!(read, serde_json::from_value::<Outer>(value).expect("it fits"));
        assert_eq!(read.choices[2], OneOf::Three { deep: 7 });
    }

    #[test]
    fn errors_name_the_place_and_the_problem() {
        let said = |value: Value| {
            let error = read::<Outer>(&value).expect_err("it does not fit");
            (error.path, error.message, error.problem)
        };
        for (value, path, message) in [
            (json!({"count": -5}), "count", "expected a whole number, 0 or more, found -5"),
            (json!({"count": "x"}), "count", "expected a whole number, 0 or more, found \"x\""),
            (json!({"count": 1.5}), "count", "expected a whole number, 0 or more, found 1.5"),
            (json!({"count": 1, "inner": 3}), "inner", "expected a table, found 3"),
            (
                json!({"count": 1, "inner": {"pair": 3}}),
                "inner.pair",
                "expected an array of length 2, found 3",
            ),
            (
                json!({"count": 1, "choices": ["four"]}),
                "choices[0]",
                "`four` is not known here; expected one of `one`, `two`, `three`",
            ),
        ] {
            let (at, text, _) = said(value);
            assert_eq!((at.as_str(), text.as_str()), (path, message));
        }
        let (at, text, problem) = said(json!({"count": 1, "inner": {"sise": "a"}}));
        assert_eq!(
            (at.as_str(), text.as_str()),
            ("inner.sise", "unknown field `sise`, expected `size` or `pair`")
        );
        assert!(matches!(problem, Problem::UnknownKey { name, .. } if name == "sise"));
        assert_eq!(said(json!({"count": 1, "inner": {"size": 3}})).2, Problem::NoText);
        assert_eq!(said(json!({})).2, Problem::Missing("count"));
        assert!(said(json!({"count": 1, "inner": {"pair": [1, 2, 3]}})).1.contains("length"));
    }
}
