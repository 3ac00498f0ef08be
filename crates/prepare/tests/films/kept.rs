//! Properties that a film keeps when it is read and written again.

use super::*;

#[test]
fn frames_times_audio_rate_and_metadata_are_kept() {
    let Some(dir) = place() else { return };
    let at = |name: &str| dir.path().join(name);
    for (ending, more) in [
        ("mp4", "-metadata title=Reef -metadata creation_time=2024-05-06T07:08:09Z"),
        ("mov", "-c:a pcm_s16le"),
        ("mkv", ""),
    ] {
        let a = film(at(&format!("a.{ending}")), format!("{PICTURE} {ENCODED} {more}").trim_end());
        let b = at(&format!("b.{ending}"));
        let reader = open(&a).unwrap();
        let info = reader.info();
        assert_eq!((info.width, info.height, info.constant, reader.frames()), (96, 64, true, 45), "{info:?}");
        assert!(ending == "mkv" || info.rate == Fraction { over: 30000, under: 1001 }, "{info:?}");
        let written = copy(&a, &b).unwrap();
        assert_eq!((written.frames, written.encoder), (45, "libx264"));
        let psnr = same(&a, &b);
        println!("{ending}: {psnr:.1} dB");
        assert!(psnr > 35.0, "{psnr}");
        assert_eq!(audio(&a), audio(&b));
        assert!(
            ending == "mkv"
                || entries(&a, "stream=avg_frame_rate,time_base")
                    == entries(&b, "stream=avg_frame_rate,time_base")
        );
        if ending == "mp4" {
            for tag in ["title=Reef", "creation_time=2024-05-06T07:08:09"] {
                let found = run("ffprobe", "-v error -show_format @", &[&b]).unwrap();
                assert!(found.contains(tag), "{found}");
            }
        }
    }
    let begins: Vec<String> = names(dir.path()).iter().map(|n| n[..1].to_string()).collect();
    assert_eq!(begins, ["a", "a", "a", "b", "b", "b"], "no temporary file is left");
}

#[test]
fn the_numbers_and_times_are_those_of_the_frames_themselves() {
    let Some(dir) = place() else { return };
    // Frame n has the grey 16 + 5 n in full range, and ffmpeg writes limited range.
    let grey = "-f lavfi -i color=black:size=64x64:rate=10:duration=4,format=gray,geq=lum=16+5*N";
    let a = film(
        dir.path().join("a.mp4"),
        &format!("{grey} -c:v libx264 -qp 4 -bf 3 -pix_fmt yuv420p -color_range tv"),
    );
    for (n, frame) in frames(&a).iter().enumerate() {
        assert_eq!(frame.number, n as u64);
        assert!((frame.seconds - 0.1 * n as f64).abs() < 1e-9, "{frame:?}");
        let expected = f64::from(16 + 5 * n as i32);
        assert!(
            (f64::from(frame.rgb[3 * 2000]) - expected).abs() < 3.0,
            "{n}: {} {expected}",
            frame.rgb[6000]
        );
    }
}

#[test]
fn a_variable_rate_is_kept() {
    let Some(dir) = place() else { return };
    let at = |name: &str| dir.path().join(name);
    let uneven = "-vf select='lt(n,20)+not(mod(n,4))' -fps_mode vfr";
    let (a, b) = (film(at("a.mp4"), &format!("{PICTURE} {uneven} {ENCODED}")), at("b.mp4"));
    let reader = open(&a).unwrap();
    assert!(!reader.info().constant && reader.frames() < 30, "{:?}", reader.info());
    drop(reader);
    copy(&a, &b).unwrap();
    same(&a, &b);
    let times = |film: &Path| entries(film, "frame=pts_time");
    assert_eq!(times(&a), times(&b));
    // A film that begins after its audio keeps its delay.
    let late = film(at("late.mp4"), &format!("-itsoffset 0.3 {PICTURE} {ENCODED} -fps_mode passthrough"));
    let c = at("c.mp4");
    copy(&late, &c).unwrap();
    same(&late, &c);
    assert_eq!(times(&late), times(&c));
    assert!(frames(&late)[0].seconds > 0.25, "{}", frames(&late)[0].seconds);
    assert_eq!(audio(&late), audio(&c));
}

#[test]
fn a_turn_is_kept_and_frames_are_not_turned() {
    let Some(dir) = place() else { return };
    let at = |name: &str| dir.path().join(name);
    let a = film(at("a.mp4"), &format!("{PICTURE} {ENCODED}"));
    let turned = at("turned.mp4");
    // This is how ffmpeg 5 writes a turn; others do it with -display_rotation.
    let old = run("ffmpeg", "-v error -i @ -c copy -metadata:s:v rotate=90 @", &[&a, &turned]).is_some();
    if !old || open(&turned).unwrap().info().display_matrix.is_none() {
        run("ffmpeg", "-v error -y -display_rotation 270 -i @ -c copy @", &[&a, &turned]).unwrap();
    }
    let info = open(&turned).unwrap().info().clone();
    assert_eq!((info.width, info.height), (96, 64));
    let turns = info.display_matrix.unwrap().quarter_turns().unwrap();
    assert!(turns % 2 == 1, "{info:?}");
    let b = at("b.mp4");
    copy(&turned, &b).unwrap();
    assert!(same(&a, &b) > 35.0);
    let matrix = |film: &Path| entries(film, "stream_side_data=displaymatrix,rotation");
    assert_eq!(matrix(&turned), matrix(&b));
    assert_eq!(audio(&turned), audio(&b));
    let said = copy(&turned, &at("b.mkv")).unwrap_err().to_string();
    assert!(said.contains("choose a name that ends in .mp4 or .mov") && !at("b.mkv").exists(), "{said}");
}

#[test]
fn colours_of_every_matrix_and_range_are_kept() {
    let Some(dir) = place() else { return };
    let at = |name: &str| dir.path().join(name);
    // Slow changes of colour, so that the halved resolution of colours counts little.
    let wave = |c: char, phase: f64| format!("{c}='128+80*sin(X/23+Y/31+N/3+{phase})'");
    let waves = [('r', 0.0), ('g', 1.3), ('b', 2.9)].map(|(c, phase)| wave(c, phase)).join(":");
    let picture = format!("-f lavfi -i color=size=128x96:rate=5:duration=1,format=gbrp,geq={waves}");
    for (name, matrix, range) in [
        ("709tv", "bt709", "tv"),
        ("709pc", "bt709", "pc"),
        ("601tv", "smpte170m", "tv"),
        ("2020", "bt2020nc", "tv"),
        ("none", "", ""),
    ] {
        let scaler = match matrix {
            "smpte170m" | "" => "bt601",
            "bt2020nc" => "bt2020",
            other => other,
        };
        let filter = format!(
            "-vf format=rgb24,scale=out_color_matrix={scaler}:out_range={}:flags=accurate_rnd,format=yuv420p",
            if range == "pc" { "pc" } else { "tv" }
        );
        let tags = if matrix.is_empty() {
            String::new()
        } else {
            format!("-colorspace {matrix} -color_range {range} -color_primaries bt709 -color_trc bt709")
        };
        let a = film(
            at(&format!("{name}.mp4")),
            format!("{picture} {filter} -c:v libx264 -qp 2 {tags}").trim_end(),
        );
        // ffmpeg 9 writes full range with colour differences that are half a level too small.
        let limit = if range == "pc" { 1.2 } else { 0.3 };
        // The true colours, without a film between.
        let raw = Command::new("ffmpeg")
            .args(format!("-v error {picture} -frames:v 1 -vf format=rgb24 -f rawvideo -").split(' '))
            .output()
            .unwrap()
            .stdout;
        let truth = FilmFrame { number: 0, seconds: 0.0, rgb: raw };
        let read = frames(&a).remove(0);
        let (psnr, means) = difference(&truth, &read);
        println!("{name}: read {psnr:.1} dB {means:?}");
        assert!(psnr > 40.0 && means.iter().all(|m| m.abs() < limit), "{name}: {psnr} {means:?}");
        let b = at(&format!("{name}-b.mp4"));
        copy(&a, &b).unwrap();
        let psnr = same(&a, &b);
        let (_, means) = difference(&read, &frames(&b)[0]);
        println!("{name}: written {psnr:.1} dB {means:?}");
        assert!(means.iter().all(|m| m.abs() < limit), "{name}: {means:?}");
        assert!(psnr > 40.0, "{name}: {psnr}");
        let tags = |film: &Path| {
            entries(film, "stream=color_range,color_space,color_transfer,color_primaries,pix_fmt")
        };
        assert_eq!(
            tags(&a).replace("yuvj420p", "yuv420p"),
            tags(&b).replace("yuvj420p", "yuv420p"),
            "{name}"
        );
    }
}

#[test]
fn an_odd_film_is_read_as_it_is_and_grows_by_a_row() {
    let Some(dir) = place() else { return };
    let at = |name: &str| dir.path().join(name);
    let picture = format!("{PICTURE} -vf scale=97:63");
    let (a, b) = (film(at("a.mp4"), &format!("{picture} -c:v libx264 -crf 8 -pix_fmt yuv444p")), at("b.mp4"));
    let all = frames(&a);
    assert_eq!(all[0].rgb.len(), 3 * 97 * 63);
    let reader = open(&a).unwrap();
    let writer = FilmWriter::create(&Programs::default(), reader.info(), &b, FilmChoices::default()).unwrap();
    assert!(writer.remarks()[0].contains("98x64"), "{:?}", writer.remarks());
    drop((writer, reader));
    copy(&a, &b).unwrap();
    let info = open(&b).unwrap().info().clone();
    assert_eq!((info.width, info.height), (98, 64));
    let cropped = |frame: &FilmFrame| {
        let rows = frame.rgb.chunks(3 * 98).take(63).flat_map(|row| row[..3 * 97].to_vec());
        FilmFrame { rgb: rows.collect(), ..frame.clone() }
    };
    let (psnr, _) = difference(&all[9], &cropped(&frames(&b)[9]));
    assert!(psnr > 25.0, "{psnr}");
}
