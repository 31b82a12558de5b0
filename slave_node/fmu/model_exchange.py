def model_exchange_2(*a, **k): raise NotImplementedError
model_exchange_3 = model_exchange_2
