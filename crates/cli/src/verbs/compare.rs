//! `use3d compare`: writes a page with two runs side by side.

use use3d_pipeline::compare;
use use3d_pipeline::destination::path_text;

use crate::App;
use crate::args::CompareArgs;
use crate::error::Done;

/// `use3d compare`.
pub(crate) fn run(app: &App, args: &CompareArgs) -> Done {
    let page = compare::page(&args.a, &args.b, format!("use3d {}", crate::version::NUMBER))?;
    let out = compare::write(&page, (&args.a, &args.b), (args.out.as_deref(), args.replace.force))?;
    if !app.quiet {
        for scene in &page.scenes {
            scene.verdict.iter().for_each(|line| println!("{}", line.text));
            println!("{}", scene.summary);
        }
        eprintln!("{}: open it in a browser", path_text(&out));
    }
    Ok(())
}
