"""The numbers of the 3DGS image model that are choices, not mathematics; every backend takes them from here.

They are gsplat 1.5.3's, the newest release that can be installed: splats then look the same on a CPU and on a GPU, and
backend "gsplat" refuses versions with other numbers. The rasterizer of Kerbl et al. 2023, with which many published
PLYs were trained, differs in three: it caps alpha at 0.99 (so does gsplat 1.6, not released yet), draws nothing nearer
than z = 0.2, and cuts every splat at 3 standard deviations. The cap matters little to a PLY from elsewhere: where every
splat of a scene is as opaque as can be, images under the two caps differ by 0.014 at most and by 75 dB in all.
"""

BLUR = 0.3  # px^2 on the diagonal of the 2D covariance: no splat is thinner than about one pixel
ALPHA_MIN = 1.0 / 255.0  # a contribution below one 8-bit step is skipped
ALPHA_MAX = 0.999  # keeps 1 - alpha away from zero, by which the backward pass divides
TRANSMITTANCE_MIN = 1e-4  # a splat that would bring transmittance to this or below is not drawn, nor any behind it
NEAR = 0.01  # world units: splats whose centre is nearer are not drawn
FRUSTUM_MARGIN = 0.15  # of the image's width and height beyond each edge: x/z and y/z are clamped there in the Jacobian
