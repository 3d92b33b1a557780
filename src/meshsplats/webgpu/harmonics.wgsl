// Real spherical harmonics of degree 1 to 3.

// sqrt(n / (m pi)): n / m is 3/4; 15/4, 5/16; 7/16, 21/32, 105/4, 35/32.
const H1 = 0.48860251;
const H2 = 1.0925485;
const H20 = 0.31539157;
const H30 = 0.37317634;
const H31 = 0.45704580;
const H32 = 2.8906114;
const H33 = 0.59004360;
const MOST_TERMS = 15u;

// The unit direction from the camera to a place in the world; 0 for the camera's own.
fn direction_to(place: vec3f) -> vec3f {
  let away = (place - frame.center.xyz) - frame.center_rest.xyz;
  let square = dot(away, away);
  return away * select(0.0, inverseSqrt(square), square > 0.0);
}

// The values for a unit direction; those of degrees above that of the mesh are not used.
fn basis_of(d: vec3f) -> array<f32, MOST_TERMS> {
  let x = d.x;
  let y = d.y;
  let z = d.z;
  let xx = x * x;
  let yy = y * y;
  let zz = z * z;
  return array<f32, MOST_TERMS>(
    -H1 * y, H1 * z, -H1 * x,
    H2 * x * y, -H2 * y * z, H20 * (2.0 * zz - xx - yy), -H2 * x * z, 0.5 * H2 * (xx - yy),
    -H33 * y * (3.0 * xx - yy), H32 * x * y * z, -H31 * y * (4.0 * zz - xx - yy),
    H30 * z * (2.0 * zz - 3.0 * (xx + yy)), -H31 * x * (4.0 * zz - xx - yy), 0.5 * H32 * z * (xx - yy),
    -H33 * x * (xx - 3.0 * yy));
}
