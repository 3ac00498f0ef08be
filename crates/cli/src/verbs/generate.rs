//! Man pages and shell completions, from the same definitions as `--help`.

use clap::CommandFactory;
use clap_complete::generate;

use crate::args::{Cli, CompletionsArgs, ManArgs};
use crate::error::{CliError, Done};

pub(crate) fn completions(args: &CompletionsArgs) -> Done {
    let mut text = Vec::new();
    generate(args.shell, &mut Cli::command(), "use3d", &mut text);
    print!("{}", String::from_utf8_lossy(&text));
    Ok(())
}

pub(crate) fn man(args: &ManArgs) -> Done {
    let failed = |e: std::io::Error| CliError::Failed(format!("--out {}: {e}", args.out.display()));
    std::fs::create_dir_all(&args.out).map_err(failed)?;
    clap_mangen::generate_to(Cli::command(), &args.out).map_err(failed)?;
    eprintln!("{}: use3d.1 and one page per verb", args.out.display());
    Ok(())
}
