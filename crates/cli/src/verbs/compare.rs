//! `use3d compare`: writes a page with two runs side by side.

use use3d_pipeline::compare;
use use3d_pipeline::destination::{check_file, path_text, write_text};

use crate::App;
use crate::args::CompareArgs;
use crate::error::{Done, WorkError};

/// `use3d compare`.
pub(crate) fn run(app: &App, args: &CompareArgs) -> Done {
    check_file("--out", &args.out, args.replace.force, &["html"])?;
    let page = compare::page(&args.a, &args.b, format!("use3d {}", crate::version::NUMBER))?;
    write_text("--out", &args.out, &page.html().map_err(WorkError::failed)?)?;
    if !app.quiet {
        for line in page.scenes.iter().flat_map(|scene| &scene.verdict) {
            println!("{}", line.text);
        }
        eprintln!("{}: open it in a browser", path_text(&args.out));
    }
    Ok(())
}
