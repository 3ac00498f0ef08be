//! Places on the earth, as metres around one of them.

use glam::DVec3;
use use3d_numerics::math;

/// The ellipsoid WGS 84: the equator's radius in metres, and the square of its eccentricity.
const RADIUS: f64 = 6_378_137.0;
const ECCENTRICITY: f64 = 0.006_694_379_990_141_316;

/// A place on the earth, by WGS 84.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct EarthPlace {
    /// Degrees, north is positive.
    pub latitude: f64,
    /// Degrees, east is positive.
    pub longitude: f64,
    /// Metres above the ellipsoid or the sea.
    pub altitude: f64,
}

impl EarthPlace {
    /// The position from the earth's centre, metres: x towards latitude and longitude 0, z north.
    pub fn position(&self) -> DVec3 {
        let (lat, lon) = (self.latitude.to_radians(), self.longitude.to_radians());
        let (sin, cos) = (math::sin(lat), math::cos(lat));
        let normal = RADIUS / (1.0 - ECCENTRICITY * sin * sin).sqrt();
        let out = (normal + self.altitude) * cos;
        DVec3::new(
            out * math::cos(lon),
            out * math::sin(lon),
            (normal * (1.0 - ECCENTRICITY) + self.altitude) * sin,
        )
    }

    /// Another place as metres east, north and up of this one.
    pub fn metres_to(&self, other: &Self) -> DVec3 {
        let (lat, lon) = (self.latitude.to_radians(), self.longitude.to_radians());
        let (sin, cos) = (math::sin(lat), math::cos(lat));
        let (sin_lon, cos_lon) = (math::sin(lon), math::cos(lon));
        let apart = other.position() - self.position();
        let east = DVec3::new(-sin_lon, cos_lon, 0.0);
        let north = DVec3::new(-sin * cos_lon, -sin * sin_lon, cos);
        let up = DVec3::new(cos * cos_lon, cos * sin_lon, sin);
        DVec3::new(east.dot(apart), north.dot(apart), up.dot(apart))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn degrees_become_metres_east_north_and_up() {
        let place = |latitude, longitude, altitude| EarthPlace { latitude, longitude, altitude };
        let here = place(0.0, 30.0, 0.0);
        // A degree of longitude on the equator is a 360th of its length; a second of latitude there is
        // 110.574 km / 3600, and at the pole 111.694 km / 3600.
        let east = here.metres_to(&place(0.0, 30.001, 0.0));
        assert!((east.x - 111.319_490_8).abs() < 1e-4 && east.y.abs() < 1e-9, "{east}");
        let north = here.metres_to(&place(1.0 / 3600.0, 30.0, 0.0));
        assert!((north.y - 30.715).abs() < 1e-2 && north.x.abs() < 1e-9, "{north}");
        let polar = place(89.9, 0.0, 0.0).metres_to(&place(89.9 + 1.0 / 3600.0, 0.0, 0.0));
        assert!((polar.y - 31.026).abs() < 1e-2, "{polar}");
        let up = place(-33.0, 151.0, -12.0).metres_to(&place(-33.0, 151.0, 3.5));
        assert!((up - DVec3::new(0.0, 0.0, 15.5)).length() < 1e-8, "{up}");
    }
}
