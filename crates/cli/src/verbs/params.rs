//! Every parameter with its default, kind and meaning.

use use3d_config::parameters;
use use3d_pipeline::loaded::stages;

use crate::args::ParamsArgs;
use crate::error::{Done, WorkError};
use crate::output::json;

pub(crate) fn run(args: &ParamsArgs) -> Done {
    let stages =
        parameters(&stages()?, args.stage.as_deref(), args.preset.as_deref()).map_err(WorkError::input)?;
    if args.json {
        return json(&stages);
    }
    for (i, stage) in stages.iter().enumerate() {
        if i > 0 {
            println!();
        }
        println!("{}: {}", stage.stage, stage.about);
        if stage.parameters.is_empty() {
            println!("  no parameters");
        }
        for parameter in &stage.parameters {
            let text = |value: &serde_json::Value| match value {
                serde_json::Value::Null => "not set".to_string(),
                serde_json::Value::String(text) => text.clone(),
                other => other.to_string(),
            };
            let (value, default) = (text(&parameter.value), text(&parameter.default));
            let changed = if value == default { String::new() } else { format!("; default {default}") };
            println!("  {}.{} = {value}   ({}{changed})", stage.stage, parameter.name, parameter.kind);
            println!("      {}", without_references(&parameter.meaning));
        }
    }
    Ok(())
}

/// A meaning without references to design decisions, such as `(R7)`, which lead nowhere outside the sources.
fn without_references(meaning: &str) -> String {
    let mut out = String::with_capacity(meaning.len());
    let mut rest = meaning;
    while let Some(at) = rest.find(" (R") {
        let inside = &rest[at + 3..];
        let digits = inside.bytes().take_while(u8::is_ascii_digit).count();
        let is_reference = digits > 0 && inside[digits..].starts_with(')');
        out.push_str(&rest[..if is_reference { at } else { at + 3 }]);
        rest = if is_reference { &inside[digits + 1..] } else { inside };
    }
    out + rest
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_of_decisions_are_left_out_and_nothing_else() {
        assert_eq!(
            without_references("Rotate the scene (R7). Not (RGB) (R27)"),
            "Rotate the scene. Not (RGB)"
        );
        assert_eq!(without_references("plain (R"), "plain (R");
    }
}
