//! The report in a real Chromium, in the light and the dark scheme. On phones nothing is wider than the
//! screen, and the divider follows a finger. Wide tables show that they continue and keep their first column.
//! In the dark scheme nothing is too bright and nothing is hidden.

#[expect(dead_code, reason = "shared with the tests of the scene's page, which do more with it")]
#[path = "../../web/tests/browser/chromium.rs"]
mod chromium;

use chromium::Chromium;
use serde_json::json;
use use3d_capture::Image;
use use3d_chart::{Plot, RGB, Series};
use use3d_report::page::{Costs, Page, Picture, PlotFigure, SceneSection, StageRow, ViewSection};
use use3d_report::tables::{Better, Cell, Column, Row, Table};
use use3d_report::verdict::{Sentence, Tone};

/// A report with everything that may be wide.
fn report() -> String {
    let long = "a_photograph_whose_name_is_longer_than_the_screen_of_any_phone_and_has_no_space.jpeg";
    let picture = |label: &str| Picture::embed(label, "", &Image::filled(480, 270, 0.4)).expect("a picture");
    let sentence = Sentence { tone: Tone::Good, text: format!("The weakest view is {long} by far.") };
    let series = |(color, dots)| Series {
        label: "one".into(),
        color,
        points: vec![(0.0, 1.0), (1.0, 2.0)],
        dots,
        names: Vec::new(),
    };
    let [red, green, blue] = RGB;
    let colors = ["#0b7285", "#e8590c", "#845ef7", "#2b8a3e", red, green, blue].map(|color| (color, false));
    let series = colors.into_iter().chain([("#0b7285", true)]).map(series).collect();
    let plot = Plot { title: "Loss".into(), x_label: "step".into(), log_y: false, series };
    let number = Cell::Number { value: 12.345, source: "reef 0123456789ab".into() };
    let table = Table {
        name: "t".into(),
        caption: format!("A caption about {long}"),
        columns: (0..12).map(|k| Column::new("Group", &format!("Column {k}"), Better::Higher, 2)).collect(),
        rows: vec![Row::own("a row".into(), vec![number; 12])],
    };
    let scene = SceneSection {
        name: "reef".into(),
        page: "reef/view.html".into(),
        summary: format!("Made of {long}."),
        verdict: vec![sentence.clone()],
        notes: vec![long.into()],
        views: vec![ViewSection {
            name: long.into(),
            place: "the middle one",
            lead: vec![picture("captured"), picture("enhanced")],
            images: vec![picture("clear"), picture("depth")],
            scores: vec!["PSNR 24.10".into()],
        }],
        plots: vec![PlotFigure { svg: plot.svg(), caption: long.into() }],
        sheets: vec![Picture { blank: Some((50.0, 60.0)), ..picture("sheet") }],
        ..SceneSection::default()
    };
    let page = Page {
        title: format!("A report on {long}"),
        verdict: vec![sentence],
        tables: vec![table],
        scenes: vec![scene],
        ..Page::default()
    };
    let row = StageRow {
        scene: "reef".into(),
        stage: "reconstruct".into(),
        state: "computed".into(),
        seconds: 1234.5,
        memory: Some(2345.0),
        size: 12.0,
        key: "0123456789abcdef".into(),
    };
    let parameters = format!("reef:\n{long}{long}");
    let costs = Some(Costs { stages: vec![row], made: long.into(), parameters });
    Page { costs, ..page }.html().expect("a page")
}

/// The marks of plots whose contrast with their background is less than a number.
const FAINT: &str = "contrast => {
    const light = text => text.match(/[\\d.]+/g).slice(0, 3).map(v => v / 255).map(v => v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4).reduce((a, v, i) => a + v * [0.2126, 0.7152, 0.0722][i], 0.05);
    return [...document.querySelectorAll('.plots polyline, .plots circle, .plots rect')].map(mark => {
        const style = getComputedStyle(mark), color = style[mark.tagName === 'polyline' ? 'stroke' : 'fill'];
        const [a, b] = [light(color), light(getComputedStyle(mark.closest('.panel')).backgroundColor)];
        return [mark.tagName, color, Math.max(a, b) / Math.min(a, b)];
    }).filter(([, , seen]) => seen < contrast);
}";

/// Checks that curves are visible on the background, heads are aligned with their columns, the labels of a
/// table's rows and columns stay visible, and no sheet has a white corner.
fn readable(browser: &mut Chromium, what: &str, contrast: f64) {
    let faint = browser.evaluate(&format!("({FAINT})({contrast})"));
    assert_eq!(faint, json!([]), "{what}: hard to see");
    let askew = browser.evaluate(
        "[...document.querySelectorAll('table')].flatMap(table => [...[...table.tHead.rows].at(-1).cells].filter((head, i) => getComputedStyle(head).textAlign !== getComputedStyle(table.tBodies[0].rows[0].cells[i]).textAlign).map(head => head.textContent)).filter(head => head)",
    );
    assert_eq!(askew, json!([]), "{what}: heads that do not stand over their columns");
    let hidden = browser.evaluate(
        "[...document.querySelectorAll('.scroll')].flatMap(box => {
            const inside = e => { const a = e.getBoundingClientRect(), b = box.getBoundingClientRect(); return a.left >= b.left - 1 && a.right <= b.right + 1; };
            const group = box.querySelector('thead th > span'), first = box.querySelector('tbody td');
            const out = group && !inside(group) ? ['group'] : [];
            box.scrollLeft = 300;
            if (!inside(first)) out.push('row');
            box.scrollLeft = 0;
            if (!getComputedStyle(box).backgroundImage.includes('gradient')) out.push('edge');
            return out;
        })",
    );
    assert_eq!(hidden, json!([]), "{what}: out of sight in a wide table");
    let corner = browser.evaluate(
        "(() => {
            const sheet = document.querySelector('img[alt=sheet]');
            sheet.scrollIntoView({ block: 'center' });
            const b = sheet.getBoundingClientRect(), at = (x, y) => document.elementFromPoint(b.left + x * b.width, b.top + y * b.height) === sheet;
            return [at(0.2, 0.9), at(0.9, 0.2), at(0.9, 0.9)];
        })()",
    );
    assert_eq!(corner, json!([true, true, false]), "{what}: the white corner of a sheet");
}

#[test]
fn a_phone_shows_all_of_the_report_and_its_divider_follows_a_finger() {
    let Some(mut browser) = Chromium::start() else { return };
    let dir = tempfile::tempdir().expect("a folder");
    let path = dir.path().join("report.html");
    std::fs::write(&path, report()).expect("written");
    for (scheme, dark) in [("light", false), ("dark", true)] {
        browser.scheme(scheme);
        for width in [320, 360, 1280] {
            browser.resize(width, 700, width < 1000);
            browser.go(&format!("file://{}", path.display()));
            browser.until("document.readyState === 'complete' && document.querySelector('.compare')");
            // The story stands on a page of bounded length, and everything else is folded.
            let height = browser.evaluate("document.documentElement.scrollHeight").as_u64();
            assert!(height <= Some(if width < 1000 { 4000 } else { 2500 }), "{width} px: {height:?}");
            browser.evaluate("document.querySelectorAll('details').forEach(d => { d.open = true; })");
            // A page that is too wide makes a phone's layout wider than its screen.
            let wide = browser.evaluate(
                "[innerWidth, document.documentElement.scrollWidth, [...document.querySelectorAll('main *')].filter(e => !e.closest('.scroll, pre, svg, .compare') && e.getBoundingClientRect().right > document.documentElement.clientWidth + 1).map(e => e.tagName + '.' + e.className)]",
            );
            assert_eq!(wide[0], json!(width), "{wide}");
            assert!(wide[1].as_u64() <= Some(width.into()) && wide[2] == json!([]), "{width} px: {wide}");
            // Thin lines are harder to see in the dark scheme.
            readable(&mut browser, &format!("{width} px, {scheme}"), if dark { 3.5 } else { 3.0 });
            // The divider follows a finger and a mouse.
            let at = "parseFloat(document.querySelector('.compare').style.getPropertyValue('--at'))";
            let place = browser.evaluate(
                "(() => { const box = document.querySelector('.compare'); box.scrollIntoView({ block: 'center' }); const b = box.getBoundingClientRect(); return [b.left, b.top, b.width, b.height]; })()",
            );
            let [left, top, across, down] = std::array::from_fn(|k| place[k].as_f64().expect("a number"));
            let y = top + down / 2.0;
            let (from, to) = ([left + 0.5 * across, y], [left + 0.25 * across, y]);
            if width < 1000 {
                browser.touch(&[(from, to)]);
            } else {
                browser.drag(from, to);
            }
            browser.until(&format!("Math.abs({at} - 25) < 2"));
            // Background and text have the requested scheme.
            let light = browser.evaluate(
                "['backgroundColor', 'color'].map(name => getComputedStyle(document.body)[name].match(/[\\d.]+/g).slice(0, 3).reduce((a, v) => a + v / 765, 0))",
            );
            let [ground, words] = [0, 1].map(|k| light[k].as_f64().expect("a number"));
            assert_eq!(ground < 0.3 && words > 0.7, dark, "{scheme}: {light}");
            assert_eq!(ground > 0.7 && words < 0.3, !dark, "{scheme}: {light}");
        }
    }
    assert_eq!(browser.complaints, Vec::<String>::new());
}
