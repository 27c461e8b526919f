"""Schedule tasks of the regularisation by normals: when they are drawn, and whose neighbours are whose."""

from sw_gaussians.knn import nearest_neighbors

from sw_trimgs.flat import FlatGaussians


class DrawSurface:
    """Has depth and normals drawn beside the colours, and finds each Gaussian's neighbours where they are unknown.

    neighbors   how many, the Gaussian itself included
    first       step of this run at which the regularisation begins
    refresh     steps after which they are searched anew though no row has come or gone

    It runs at every step, so that a resumed training goes on as before; the list is a buffer of the model.
    """

    def __init__(self, neighbors: int, *, first: int, refresh: int) -> None:
        self.neighbors, self.first, self.refresh = neighbors, first, refresh

    def __call__(self, model: FlatGaussians, step: int) -> None:
        model.draws_surface = True
        if len(model.neighbors) != model.num_rows or (step - self.first) % self.refresh == 0:
            model.neighbors = nearest_neighbors(model.means, self.neighbors)


def forget_neighbors(model: FlatGaussians) -> None:
    """Drop the list of neighbours, as rows came or went."""
    model.forget_neighbors()
