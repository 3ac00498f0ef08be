//! A canonical encoding: equal parameters have equal bytes.
//!
//! Parameters arrive as JSON values made from typed structs. Objects are written in key order, integers and
//! floating point numbers with different tags, floating point numbers by their bits after `-0.0` became
//! `0.0`. So the order in which a file lists its keys, a locale or a map's iteration order cannot change a
//! key of the cache.

use serde_json::Value;

use use3d_code::digest::Encoder;

/// Appends `value` to `encoder` canonically.
pub fn encode<'e>(value: &Value, encoder: &'e mut Encoder) -> &'e mut Encoder {
    match value {
        Value::Null => encoder.number(0),
        Value::Bool(yes) => encoder.number(1).number(u64::from(*yes)),
        Value::Number(number) => {
            if let Some(n) = number.as_u64() {
                encoder.number(2).number(n)
            } else if let Some(n) = number.as_i64() {
                encoder.number(3).number(n.cast_unsigned())
            } else {
                let n = number.as_f64().unwrap_or(f64::NAN);
                encoder.number(4).number(if n == 0.0 { 0 } else { n.to_bits() })
            }
        }
        Value::String(text) => encoder.number(5).text(text),
        Value::Array(items) => {
            let list = encoder.number(6).number(items.len() as u64);
            items.iter().fold(list, |list, item| encode(item, list))
        }
        Value::Object(fields) => {
            let table = encoder.number(7).number(fields.len() as u64);
            let mut sorted: Vec<_> = fields.iter().collect();
            sorted.sort_by_key(|(name, _)| name.as_str());
            sorted.into_iter().fold(table, |table, (name, item)| encode(item, table.text(name)))
        }
    }
}

/// A value in a form for people: numbers that are exactly an `f32` have the `f32`'s shortest form.
pub fn display(value: &Value) -> String {
    match value {
        Value::Number(n) if n.is_f64() => {
            let wide = n.as_f64().unwrap_or(f64::NAN);
            let narrow = wide as f32;
            if f64::from(narrow) == wide { narrow.to_string() } else { wide.to_string() }
        }
        Value::Null => "unset".to_string(),
        Value::Array(items) => format!("[{}]", items.iter().map(display).collect::<Vec<_>>().join(", ")),
        Value::Object(fields) => {
            let each: Vec<_> = fields.iter().map(|(k, v)| format!("{k} = {}", display(v))).collect();
            format!("{{ {} }}", each.join(", "))
        }
        other => other.to_string(),
    }
}

/// The value at a dotted path, e.g. `split.every`.
pub fn at<'v>(value: &'v Value, path: &str) -> Option<&'v Value> {
    path.split('.').try_fold(value, |here, name| here.get(name))
}

/// Removes the value at a dotted path, if it is there.
pub fn remove(value: &mut Value, path: &str) {
    let (parent, name) = path.rsplit_once('.').unwrap_or(("", path));
    let mut parts = parent.split('.').filter(|p| !p.is_empty());
    let holder = parts.try_fold(value, |here, part| here.get_mut(part));
    if let Some(fields) = holder.and_then(Value::as_object_mut) {
        fields.remove(name);
    }
}

/// Lists every leaf with its dotted path, in order, so that two parameter sets can be compared field by
/// field.
pub fn leaves(value: &Value) -> Vec<(String, &Value)> {
    fn walk<'v>(path: &str, value: &'v Value, out: &mut Vec<(String, &'v Value)>) {
        match value {
            Value::Object(fields) if !fields.is_empty() => {
                for (name, item) in fields {
                    let path = if path.is_empty() { name.clone() } else { format!("{path}.{name}") };
                    walk(&path, item, out);
                }
            }
            _ => out.push((path.to_string(), value)),
        }
    }
    let mut out = Vec::new();
    walk("", value, &mut out);
    out
}

/// Merges `over` into `base`: objects merge field by field, anything else replaces.
pub fn merge(base: &mut Value, over: &Value) {
    match (base, over) {
        (Value::Object(base), Value::Object(over)) => {
            for (name, item) in over {
                merge(base.entry(name).or_insert(Value::Null), item);
            }
        }
        (base, over) => *base = over.clone(),
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use serde_json::json;

    use super::*;
    use use3d_code::digest::Digest;

    fn digest(value: &Value) -> Digest {
        let mut encoder = Encoder::new("test");
        encode(value, &mut encoder);
        encoder.finish()
    }

    fn any_value() -> impl Strategy<Value = Value> {
        let leaf = prop_oneof![
            Just(Value::Null),
            any::<bool>().prop_map(Value::from),
            any::<i64>().prop_map(Value::from),
            any::<u64>().prop_map(Value::from),
            (-1e6..1e6).prop_map(|x: f64| Value::from(x)),
            "[a-c]{0,3}".prop_map(Value::from),
        ];
        leaf.prop_recursive(3, 24, 4, |inner| {
            prop_oneof![
                prop::collection::vec(inner.clone(), 0..4).prop_map(Value::from),
                prop::collection::btree_map("[a-c]{1,2}", inner, 0..4)
                    .prop_map(|m| Value::Object(m.into_iter().collect())),
            ]
        })
    }

    proptest! {
        #[test]
        fn equal_values_and_only_they_have_equal_digests(a in any_value(), b in any_value()) {
            prop_assert_eq!(a == b, digest(&a) == digest(&b));
            let again: Value = serde_json::from_str(&a.to_string()).expect("JSON");
            prop_assert_eq!(digest(&a), digest(&again));
        }
    }

    #[test]
    fn order_and_negative_zero_do_not_count_but_types_do() {
        let a: Value = serde_json::from_str(r#"{"x": 1, "y": {"b": -0.0, "a": 2}}"#).expect("JSON");
        let b: Value = serde_json::from_str(r#"{"y": {"a": 2, "b": 0.0}, "x": 1}"#).expect("JSON");
        assert_eq!(digest(&a), digest(&b));
        assert_ne!(digest(&json!(1)), digest(&json!(1.0)));
        assert_ne!(digest(&json!("1")), digest(&json!(1)));
        assert_ne!(digest(&json!([])), digest(&json!({})));
    }

    #[test]
    fn paths_and_merging() {
        let mut value = json!({"split": {"every": 8, "order": "name"}, "size": null});
        assert_eq!(at(&value, "split.every"), Some(&json!(8)));
        merge(&mut value, &json!({"split": {"every": 4}, "size": "64x48"}));
        assert_eq!(value, json!({"split": {"every": 4, "order": "name"}, "size": "64x48"}));
        remove(&mut value, "split.order");
        remove(&mut value, "nothing.here");
        let names: Vec<_> = leaves(&value).into_iter().map(|(name, _)| name).collect();
        assert_eq!(names, ["size", "split.every"]);
        assert_eq!(display(&json!(f64::from(0.1_f32))), "0.1");
        assert_eq!(display(&Value::Null), "unset");
        assert_eq!(display(&json!({"a": [1, 2.5]})), "{ a = [1, 2.5] }");
    }
}
