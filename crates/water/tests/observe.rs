//! Observations of tracks in views, and tracks and images that do not belong together.

use glam::{DMat3, DVec3};
use use3d_capture::{Camera, Image, Intrinsics, Map, Pose, Sighting, Track};
use use3d_water::{Observation, ObserveError, Sights, observe_sizes};

const LENS: Intrinsics = Intrinsics { width: 80, height: 60, fx: 70.0, fy: 70.0, cx: 40.0, cy: 30.0 };

/// Two cameras that look along z; the second is twice as far from the point at the origin.
fn cameras() -> Vec<Camera> {
    let at = |z: f64| Camera {
        intrinsics: LENS,
        pose: Pose::from_center(DMat3::IDENTITY, DVec3::new(0.0, 0.0, z)),
    };
    vec![at(-4.0), at(-8.0)]
}

fn sighting(view: usize) -> Sighting {
    Sighting { view, x: 40.0, y: 30.0 }
}

fn track(sightings: Vec<Sighting>) -> Track {
    Track { position: DVec3::ZERO, sightings }
}

/// A disc around the centre that covers the same piece of surface in both cameras: half as wide from twice
/// as far.
fn disc(view: usize) -> Image {
    let mut image = Image::new(80, 60);
    let radius = [6.0, 3.0][view];
    for y in 0..60 {
        for x in 0..80 {
            let off = (x as f64 + 0.5 - 40.0, y as f64 + 0.5 - 30.0);
            let value = if off.0 * off.0 + off.1 * off.1 < radius * radius { 0.8 } else { 0.2 };
            image.set_pixel(x, y, [value; 3]);
        }
    }
    image
}

/// The observations in the images at their own size.
fn observe(
    cameras: &[Camera],
    tracks: &[Track],
    load: impl FnMut(usize) -> Result<Option<(Image, Option<Map>)>, ObserveError>,
) -> Result<Sights, ObserveError> {
    observe_sizes(cameras, tracks, load).map(|[whole, _]| whole)
}

fn look(tracks: &[Track]) -> Vec<Observation> {
    observe(&cameras(), tracks, |view| Ok(Some((disc(view), None)))).unwrap().points
}

#[test]
fn both_views_average_the_same_piece_of_surface() {
    let found = look(&[track(vec![sighting(1), sighting(0)])]);
    assert_eq!(
        found.iter().map(|o| (o.point, o.view, o.distance)).collect::<Vec<_>>(),
        [(0, 0, 4.0), (0, 1, 8.0)]
    );
    assert_eq!(found[0].direction, DVec3::Z);
    // With the same window in pixels for both views they would differ by 0.2 or more.
    assert!((found[0].value[1] - found[1].value[1]).abs() < 0.05, "{found:?}");
    assert!(found[0].spread[1] > 0.1 && found[1].spread[1] > 0.1);
}

#[test]
fn views_may_be_left_out_and_lonely_or_impossible_sightings_are() {
    let behind = Track { position: DVec3::new(0.0, 0.0, -20.0), ..track(vec![sighting(0), sighting(1)]) };
    let outside = track(vec![Sighting { x: -3.0, ..sighting(0) }, Sighting { y: f64::NAN, ..sighting(1) }]);
    let twice = track(vec![sighting(0), sighting(0)]);
    assert_eq!(look(&[behind, outside, twice, track(vec![])]), []);
    let some = observe(&cameras(), &[track(vec![sighting(0), sighting(1)])], |view| {
        Ok((view == 1).then(|| (disc(view), None)))
    });
    assert_eq!(some.unwrap().points.iter().map(|o| o.view).collect::<Vec<_>>(), [1]);
    let masked = observe(&cameras(), &[track(vec![sighting(0), sighting(1)])], |view| {
        Ok(Some((disc(view), Some(Map::filled(80, 60, view as f32)))))
    });
    assert_eq!(masked.unwrap().points.iter().map(|o| o.view).collect::<Vec<_>>(), [1]);
}

#[test]
fn tracks_and_images_of_another_capture_are_refused_by_name() {
    let none = |_| -> Result<Option<(Image, Option<Map>)>, ObserveError> { Ok(None) };
    let error = observe(&cameras(), &[track(vec![sighting(5)])], none).unwrap_err();
    assert_eq!(error, ObserveError::View { track: 0, view: 5, views: 2 });
    let both = [track(vec![sighting(0), sighting(1)])];
    let error = observe(&cameras(), &both, |_| Ok(Some((Image::new(8, 8), None)))).unwrap_err();
    assert!(error.to_string().contains("8x8") && error.to_string().contains("80x60"), "{error}");
}

#[test]
fn half_the_size_shows_the_same_surface_in_half_as_many_pixels() {
    let tracks = [track(vec![sighting(0), sighting(1)])];
    let even = |view: usize| Image::filled(80, 60, [0.3, 0.6][view]);
    let [whole, half] =
        observe_sizes::<ObserveError>(&cameras(), &tracks, |view| Ok(Some((even(view), None)))).unwrap();
    assert_eq!(whole.points.len(), 2);
    for (a, b) in whole.points.iter().zip(&half.points) {
        assert_eq!((a.point, a.view, a.distance, a.direction), (b.point, b.view, b.distance, b.direction));
        assert!((a.value[0] - b.value[0]).abs() < 1e-6);
    }
    // A disc: at half size the window covers as many pixels, and so more of the surface.
    let [whole, half] =
        observe_sizes::<ObserveError>(&cameras(), &tracks, |view| Ok(Some((disc(view), None)))).unwrap();
    assert!(half.points[1].value[1] < whole.points[1].value[1], "{whole:?} {half:?}");
    let error = observe_sizes::<ObserveError>(&cameras(), &tracks, |_| Ok(Some((Image::new(8, 8), None))));
    assert!(error.unwrap_err().to_string().contains("8x8"));
}
