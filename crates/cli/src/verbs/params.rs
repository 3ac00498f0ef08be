//! Every parameter with its default, range and meaning.

use use3d_pipeline::config::parameters;

use crate::args::ParamsArgs;
use crate::error::{CliError, Done};
use crate::verbs::run::json;
use crate::verbs::stages::stages;

pub(crate) fn run(args: &ParamsArgs) -> Done {
    let stages =
        parameters(&stages()?, args.stage.as_deref(), args.preset.as_deref()).map_err(CliError::input)?;
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
            println!("      {}", parameter.meaning);
        }
    }
    Ok(())
}
