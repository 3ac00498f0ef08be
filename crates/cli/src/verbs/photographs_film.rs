//! A film in, a film out: all frames of the film from which a capture was prepared, in the light and colours
//! of its scene.

use std::path::Path;

use use3d_import::Originals;
use use3d_pipeline::destination::path_text;
use use3d_pipeline::photographs::film::{FilmGrader, spans};
use use3d_prepare::{
    FilmChoices, FilmPath, FilmReader, FilmWriter, PrepareError, Programs, StepProgress, StepWatch,
    known_frames,
};
use use3d_stages::Appearance;
use use3d_stages::Drawn;

use crate::App;
use crate::error::{Done, WorkError};
use crate::output::counted;

/// A film to enhance.
pub(crate) struct FilmJob<'a> {
    pub(crate) film: &'a Path,
    pub(crate) video: &'a Path,
    pub(crate) capture: &'a Path,
    pub(crate) replace: bool,
}

/// Enhances all frames of a film.
pub(crate) fn write(
    app: &App,
    job: &FilmJob<'_>,
    scene: &Drawn<'_>,
    originals: &Originals,
    appearance: &Appearance,
) -> Done {
    let programs = Programs::default();
    let progress = |StepProgress { step, done, total, unit }| app.host.progress(step, done, total, unit, "");
    let note = |text: &str| remark!(app, "{text}");
    let watch = StepWatch { stop: &app.host.stop, progress: &progress, note: &note };
    let known = known_frames(&programs, job.capture, job.film, &watch)?;
    let mut reader = FilmReader::open(&programs, job.film, &watch)?;
    let info = reader.info().clone();
    for line in info.remarks() {
        remark!(app, "{line}");
    }
    let turns = info.display_matrix.as_ref().map_or(Some(0), |matrix| matrix.quarter_turns());
    let turns = turns.ok_or_else(|| {
        WorkError::Input(format!(
            "{}: a player turns this film by an angle or mirrors it; convert it with ffmpeg first, and prepare \
             the result",
            path_text(job.film)
        ))
    })?;
    let choices = FilmChoices { replace: job.replace, quality: None };
    let mut writer = FilmWriter::create(&programs, &info, job.video, choices)?;
    for line in writer.remarks() {
        remark!(app, "{line}");
    }
    let names: Vec<&str> = known.iter().map(|frame| frame.photograph.as_str()).collect();
    let poses = known.iter().filter_map(|frame| {
        let own = originals.photographs.iter().find(|original| original.relative == frame.photograph)?;
        Some((frame.seconds, own.pose))
    });
    let path = FilmPath::new(&poses.collect::<Vec<_>>(), None);
    let stored = (info.width, info.height);
    let mut grader = FilmGrader::new(scene, originals, appearance, &names, (stored, turns))?;
    let (total, mut far) = (reader.frames(), Vec::new());
    for frame in reader.by_ref() {
        let mut frame = frame?;
        if app.host.stops() {
            return Err(PrepareError::Interrupted.into());
        }
        app.host.progress("film", frame.number, total, "frames", "");
        let pose = path.at(frame.seconds).pose();
        if pose.is_none() {
            far.push((frame.number, frame.seconds));
        }
        grader.grade(&mut frame.rgb, pose)?;
        writer.write(&frame.rgb, frame.seconds)?;
    }
    let damages = reader.damages();
    let written = writer.finish()?;
    app.host.over("film");
    remark!(
        app,
        "{}: {} written by {}",
        path_text(&written.path),
        counted(usize::try_from(written.frames).unwrap_or(usize::MAX), "frame", "frames"),
        written.encoder
    );
    if !far.is_empty() {
        remark!(
            app,
            "no camera of the scene is near {} ({}): changed by the scene's mean",
            counted(far.len(), "frame", "frames"),
            spans(&far)
        );
    }
    if damages > 0 {
        remark!(app, "the film has {damages} damaged places; frames there may look broken");
    }
    Ok(())
}
