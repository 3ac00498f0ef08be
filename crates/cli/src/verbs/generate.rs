//! Man pages and shell completions, from the same definitions as `--help`.

use clap::CommandFactory;
use clap_complete::generate;
use use3d_pipeline::by_hand::scratch;
use use3d_pipeline::destination::{check_file, copy_file};

use crate::args::{Cli, CompletionsArgs, ManArgs};
use crate::error::{Done, WorkError};

pub(crate) fn completions(args: &CompletionsArgs) -> Done {
    let mut text = Vec::new();
    generate(args.shell, &mut Cli::command(), "use3d", &mut text);
    print!("{}", String::from_utf8_lossy(&text));
    Ok(())
}

/// Writes the pages to a temporary folder first: nothing in the target folder is replaced without `--force`,
/// and no page is written through a link.
pub(crate) fn man(args: &ManArgs) -> Done {
    let failed = |e: std::io::Error| WorkError::Failed(format!("--out {}: {e}", args.out.display()));
    let made = scratch()?;
    clap_mangen::generate_to(Cli::command().version(crate::version::NUMBER), made.path()).map_err(failed)?;
    let mut pages = Vec::new();
    for entry in std::fs::read_dir(made.path()).map_err(failed)? {
        let entry = entry.map_err(failed)?;
        pages.push((entry.path(), args.out.join(entry.file_name())));
    }
    pages.sort();
    // An existing page with the same content is left alone.
    let same = |made: &std::path::Path, there: &std::path::Path| {
        std::fs::symlink_metadata(there).is_ok_and(|found| found.is_file())
            && std::fs::read(there).ok() == std::fs::read(made).ok()
    };
    pages.retain(|(made, there)| !same(made, there));
    pages.iter().try_for_each(|(_, there)| check_file("--out", there, args.replace.force, &[]))?;
    pages.iter().try_for_each(|(made, there)| copy_file("--out", made, there))?;
    eprintln!("{}: use3d.1 and one page per verb", args.out.display());
    Ok(())
}
