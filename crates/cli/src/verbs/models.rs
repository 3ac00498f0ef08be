//! Networks trained by others: what is looked for, what is there.

use crate::args::ModelsArgs;
use crate::error::{CliError, Done};

#[cfg(feature = "nets")]
pub(crate) fn run(args: &ModelsArgs) -> Done {
    use use3d_nets::models::Verdict;

    let dir = args.dir.clone().unwrap_or_else(|| "models".into());
    let status = use3d_nets::Models::open(&dir).status().map_err(CliError::input)?;
    if args.json {
        return crate::verbs::run::json(&status);
    }
    println!("models folder: {}\n", dir.display());
    for row in &status {
        let (mark, file) = match &row.found {
            Some(found) => {
                let verdict = match &found.verdict {
                    Verdict::Official => "official".to_string(),
                    Verdict::Unknown => "digest not published".to_string(),
                    Verdict::Different { expected } => format!("NOT the official file (expected {expected})"),
                };
                ("found  ", format!("{} ({verdict}, sha256 {})", found.path.display(), &found.sha256[..16]))
            }
            None => ("missing", format!("put {} here", row.known.files.join(" or "))),
        };
        println!("{mark}  {:<28} {}", row.known.title, row.known.used_for);
        println!("         {file}");
        println!(
            "         {:.1} MB, {}, {}\n",
            row.known.bytes as f64 / 1e6,
            row.known.licence,
            row.known.origin
        );
    }
    println!("Nothing is ever downloaded by this program.");
    Ok(())
}

#[cfg(not(feature = "nets"))]
pub(crate) fn run(_: &ModelsArgs) -> Done {
    Err(CliError::Input("this program was built without networks (cargo feature `nets`)".into()))
}
