import torch
from torch.testing import assert_close

import mambaloc


@torch.no_grad()
def test_the_four_directions_end_in_the_global_feature():
    """Against four plain LSTMs over the matrix, each run step by step in its direction."""
    torch.manual_seed(0)
    system = mambaloc.create_model("lstm_posenet", backbone="mobilenetv3_small_050", image_size=64, hidden=8).eval()
    network, image = system.network, torch.rand(2, 3, 64, 64)
    matrix = network.fc(network.backbone(image)).reshape(2, 32, 64)

    def last_state(lstm: torch.nn.LSTM, steps: torch.Tensor, suffix: str) -> torch.Tensor:
        weights = {
            name: getattr(lstm, f"{name}_l0{suffix}") for name in ("weight_ih", "weight_hh", "bias_ih", "bias_hh")
        }
        cell = torch.nn.LSTMCell(lstm.input_size, lstm.hidden_size)
        cell.load_state_dict(weights)
        hidden = state = torch.zeros(2, lstm.hidden_size)
        for step in steps.unbind(1):
            hidden, state = cell(step, (hidden, state))
        return hidden

    down = last_state(network.down_and_up, matrix, "")
    up = last_state(network.down_and_up, matrix.flip(1), "_reverse")
    right = last_state(network.right_and_left, matrix.mT, "")
    left = last_state(network.right_and_left, matrix.mT.flip(1), "_reverse")
    expected = torch.cat((down, up, right, left), dim=-1)
    for feature in network.features(network.backbone(image)):
        assert_close(feature, expected, rtol=1e-4, atol=1e-5)


def test_four_outputs_as_first_published():
    small = {"backbone": "mobilenetv3_small_050", "image_size": 64, "hidden": 8}
    network = mambaloc.create_model("lstm_posenet", rotation="quaternion", **small).network
    assert network.head.rotation[-1].out_features == 4
    assert network(torch.rand(2, 3, 64, 64)).log_quaternion is None
